"""Views that a reconstruction is told to leave out."""

import math

import numpy as np
import pytest

import clra
from clra.model.phantom import Ellipsoids

BODY = Ellipsoids([[0, 0, 0], [0.2, 0.1, 0]], [[0.6, 0.6, 0.5], [0.1, 0.2, 0.1]], [1.0, 0.5])
BELIEVED = np.arange(121) % 40 != 7


@pytest.fixture(scope="module")
def scan():
    geometry = clra.helix(
        121,
        angle_step=math.radians(5.9),
        z_step=0.008,
        source_to_axis=4.0,
        source_to_detector=8.0,
        pixel_size=0.06,
        shape=(67, 71),
    )
    return clra.Scan(BODY.line_integrals(geometry), geometry)


def _spoilt(scan, value):
    pixels = scan.read(0, scan.views).copy()
    pixels[~BELIEVED] = value
    return clra.Scan(pixels, scan.geometry)


@pytest.mark.parametrize("method", ["fbp", "osem-tr", "imgr"])
def test_what_is_not_believed_does_not_matter(scan, method):
    volumes = [
        clra.reconstruct(_spoilt(scan, value), method, believed=BELIEVED) for value in (0.0, 9.0)
    ]
    assert np.array_equal(*volumes)
    believing = clra.reconstruct(_spoilt(scan, 9.0), method)
    assert np.abs(believing - volumes[0]).max() > 0.05


def test_aligning_on_the_way_finds_them_out(scan):
    good, bad = (clra.reconstruct(s, align=True) for s in (scan, _spoilt(scan, 9.0)))
    assert np.sqrt(np.mean((bad - good) ** 2)) < 0.05


def test_katsevich_needs_every_view_and_says_so(scan):
    with pytest.warns(UserWarning, match="katsevich needs every view: 3 that are not believed"):
        clra.reconstruct(scan, "katsevich", believed=BELIEVED)


@pytest.mark.parametrize("believed", [np.ones(7, np.bool_), np.zeros(121, np.bool_)])
def test_choices_that_are_none(scan, believed):
    with pytest.raises(ValueError, match="believed: found"):
        clra.reconstruct(scan, believed=believed)
