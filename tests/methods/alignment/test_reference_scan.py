"""Slow drift against a reference scan; radiographs are closed forms, the drift is known."""

import numpy as np
import pytest

import clra
from clra.app.simulation import paper_like, sample
from clra.model.phantoms.perturbation import random_motion, smooth_motion

VIEWS, SHAPE, EVERY = 180, (112, 128), 6
# Mean absolute errors [pixel]: pairs of 112 x 128 are registered to 0.01, the curve between them
# is missed by as much again.
TOLERANCE = 0.05


@pytest.fixture(scope="module")
def geometry():
    return paper_like("helix", VIEWS, SHAPE)


@pytest.fixture(scope="module")
def rock(geometry):
    return sample("porous", geometry, 1)


@pytest.fixture(scope="module")
def reference(geometry, rock):
    still = geometry.subset(slice(0, None, EVERY))
    return clra.Scan(rock.line_integrals(still), still, name="quick")


@pytest.fixture(scope="module")
def drift():
    return smooth_motion(VIEWS, seed=1, shift=(-10, 8), magnification=0.002)


@pytest.fixture(scope="module")
def drifted(geometry, rock, drift):
    return clra.Scan(rock.line_integrals(geometry.with_motion(drift)), geometry, truth=drift)


def _errors(motion, truth):
    return [
        np.abs(getattr(motion, name) - getattr(truth, name)).mean()
        for name in ("shift_u", "shift_v", "magnification")
    ]


def test_drift_is_found_with_its_gauge(drifted, reference, drift):
    found = clra.align(drifted, method="reference", reference=reference)
    u, v, m = _errors(found.motion, drift)
    assert u < TOLERANCE and v < TOLERANCE and m < 2e-4
    assert found.schedule == "reference"
    (entry,) = found.history
    assert (entry.mae_u, entry.mae_v) == pytest.approx((u, v))
    assert found.confidence.shape == (VIEWS,) and (found.confidence > 0.9).all()
    assert found.sigma.shape == (VIEWS, 3)


def test_magnification_is_left_alone_unless_estimated(drifted, reference):
    found = clra.align(drifted, method="reference", reference=reference, estimate="shift")
    assert (found.motion.magnification == 1).all()


def test_alignment_starts_from_it_and_keeps_its_gauge(geometry, rock, reference, drift):
    truth = drift.then(random_motion(VIEWS, seed=5, shift=(-1, 1)))
    scan = clra.Scan(rock.line_integrals(geometry.with_motion(truth)), geometry, truth=truth)
    alone = clra.align(scan, method="reference", reference=reference).motion
    after = clra.align(scan, reference=reference, schedule="1QR-1HR", quality=False).motion
    without = clra.align(scan, schedule="1QR-1HR", quality=False).motion
    for axis in (0, 1):
        assert _errors(after, truth)[axis] < 0.5 * _errors(alone, truth)[axis]
        assert _errors(after, truth)[axis] < 0.5 * _errors(without, truth)[axis]


def test_a_bad_reference_view_and_a_place_never_seen_do_no_harm(drifted, reference, drift):
    pixels = reference.read(0, reference.views).copy()
    pixels[9] = 0.0
    geometry = reference.geometry
    turned = clra.ConeBeamGeometry(
        source=np.where(np.arange(reference.views)[:, None] == 4, 1.3, 1.0) * geometry.source,
        detector=geometry.detector,
        u=geometry.u,
        v=geometry.v,
        shape=geometry.shape,
    )
    with pytest.warns(UserWarning, match="1 of 30 views look like none"):
        found = clra.align(drifted, method="reference", reference=clra.Scan(pixels, turned))
    u, v, _ = _errors(found.motion, drift)
    assert u < 2 * TOLERANCE and v < 2 * TOLERANCE


def test_a_reference_that_ends_half_way_is_told(drifted, reference, drift):
    with pytest.warns(UserWarning, match="beside 0 to 90 of scan's 0 to 179: beyond these"):
        found = clra.align(drifted, method="reference", reference=reference.subset(slice(0, 16)))
    assert np.abs(found.motion.shift_v - drift.shift_v)[:90].mean() < TOLERANCE
    assert np.abs(found.motion.shift_v - drift.shift_v)[90:].mean() > 1


def test_what_is_no_reference_is_refused(drifted, reference, drift):
    with pytest.raises(ValueError, match="quick: found 4 views that look like one of"):
        clra.align(drifted, method="reference", reference=reference.subset(slice(0, 4)))
    other = clra.Scan(np.zeros((9, 8, 8)), clra.circular(
        9, source_to_axis=5.0, source_to_detector=50.0, pixel_size=1.0, shape=(8, 8)
    ))  # fmt: skip
    with pytest.raises(ValueError, match=r"detector: found 8 x 8 pixels, expected 112 x 128"):
        clra.align(drifted, reference=other)
    with pytest.raises(ValueError, match="reference, motion: found both"):
        clra.align(drifted, reference=reference, motion=drift)
    with pytest.raises(ValueError, match="reference, motion: found none with method='reference'"):
        clra.align(drifted, method="reference")
