"""What radiographs alone tell, on scans of balls in closed form."""

import numpy as np
import pytest

import clra
from clra.errors import InputError
from clra.methods.assessment.radiograph_checks import radiograph_findings, refuse_counts
from clra.model.phantoms.ellipsoids import Ellipsoids

VIEWS, SHAPE = 40, (48, 64)


def circle(arc=2 * np.pi):
    return clra.circular(
        VIEWS,
        source_to_axis=4.0,
        source_to_detector=20.0,
        pixel_size=0.1,
        shape=SHAPE,
        arc=arc,
    )


def balls(radius=0.4):
    random = np.random.default_rng(1)
    places = random.uniform(-0.5, 0.5, (20, 3)) * radius
    return Ellipsoids(places, random.uniform(0.1, 0.3, 20) * radius, np.full(20, 2.0))


@pytest.fixture(scope="module")
def integrals():
    images = balls().line_integrals(circle()).astype(np.float64)
    photons = np.random.default_rng(2).poisson(2e4 * np.exp(-images)) / 2e4
    return -np.log(photons)


def codes(images, geometry=None):
    scan = clra.Scan(np.asarray(images, np.float32), geometry or circle())
    return [finding.code for finding in radiograph_findings(scan)]


def test_nothing_is_said_of_a_good_scan(integrals):
    assert codes(integrals) == []


def test_nothing_is_said_of_one_without_noise():
    assert codes(balls().line_integrals(circle())) == []


def test_a_fading_beam_is_told(integrals):
    left = 1 - 0.2 * np.linspace(0, 1, VIEWS)
    assert codes(integrals - np.log(left)[:, None, None]) == ["beam-decay"]


def test_a_truncated_sample_is_told():
    wide = Ellipsoids([[0, 0, 0]], [[0.9, 0.9, 0.3]], [1.0])
    assert codes(wide.line_integrals(circle())) == ["truncation"]


def test_pixels_cut_off_are_told(integrals):
    assert codes(np.minimum(integrals, 0.4 * integrals.max())) == ["clipped-detector"]
    lowest = np.quantile(integrals, 0.5) + 0.05
    assert codes(np.maximum(integrals, lowest)) == ["clipped-detector"]


def test_a_part_of_half_a_turn_is_told(integrals):
    assert codes(integrals, circle(np.radians(150))) == ["limited-arc"]


def test_counts_are_no_transmission(integrals):
    transmission = np.exp(-integrals).astype(np.float32)
    refuse_counts(clra.Scan(transmission, circle(), "transmission"))
    with pytest.raises(InputError, match="expected I / I0"):
        refuse_counts(clra.Scan(5000 * transmission, circle(), "transmission"))
    with pytest.raises(InputError, match="expected I / I0"):
        clra.align(clra.Scan(5000 * transmission, circle(), "transmission"))


@pytest.mark.parametrize(
    ("half_height", "told"),
    [(0.5, []), (1.4, ["axial-truncation"])],  # the scan covers 0.72 to each side of the middle
)
def test_a_sample_longer_than_a_helix_is_told(half_height, told):
    geometry = clra.helix(
        VIEWS,
        angle_step=6 * np.pi / VIEWS,
        z_step=0.96 / VIEWS,
        source_to_axis=4.0,
        source_to_detector=20.0,
        pixel_size=0.1,
        shape=SHAPE,
    )
    rod = Ellipsoids([[0.1, 0, 0]], [[0.3, 0.3, half_height]], [1.0])
    assert codes(rod.line_integrals(geometry), geometry) == told


def test_a_sample_longer_than_a_circle_sees_does_no_harm():
    rod = Ellipsoids([[0.1, 0, 0]], [[0.3, 0.3, 1.4]], [1.0])
    assert codes(rod.line_integrals(circle())) == []
