"""Views and pixels that a reconstruction is told to leave out."""

import math
import re

import numpy as np
import pytest

import clra
from clra.errors import InputError
from clra.methods.alignment.result import AlignmentResult
from clra.model.corrections.correction_options import CorrectionOptions
from clra.model.grid import default_grid
from clra.model.phantoms.ellipsoids import Ellipsoids

BODY = Ellipsoids([[0, 0, 0], [0.2, 0.1, 0]], [[0.6, 0.6, 0.5], [0.1, 0.2, 0.1]], [1.0, 0.5])
VALID = np.arange(121) % 40 != 7


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
    pixels[~VALID] = value
    return clra.Scan(pixels, scan.geometry)


@pytest.mark.parametrize("method", ["fbp", "osem-tr", "imgr"])
def test_what_is_not_valid_views_does_not_matter(scan, method):
    volumes = [
        clra.reconstruct(_spoilt(scan, value), method, valid_views=VALID) for value in (0.0, 9.0)
    ]
    assert np.array_equal(*volumes)
    trusting = clra.reconstruct(_spoilt(scan, 9.0), method)
    assert np.abs(trusting - volumes[0]).max() > 0.05


def test_views_that_an_alignment_rejected_are_left_out(scan):
    motion = clra.Motion(shift_u=np.full(121, 0.4), shift_v=np.zeros(121))
    alignment = AlignmentResult.from_motion(motion, VALID)
    volume = clra.reconstruct(_spoilt(scan, 9.0), alignment=alignment)
    expected = clra.reconstruct(_spoilt(scan, 0.0), motion=motion, valid_views=VALID)
    assert np.array_equal(volume, expected)
    with pytest.raises(InputError, match="found more than one, expected one of them"):
        clra.reconstruct(scan, motion=motion, alignment=alignment)


@pytest.mark.parametrize("method", ["fbp", "katsevich", "osem-tr", "imgr"])
def test_what_masked_pixels_hold_does_not_matter(scan, method):
    mask = np.ones(scan.geometry.shape, np.bool_)
    mask[30:32, 40:42] = mask[33, 20] = False
    grid = default_grid(scan.geometry)
    truth = BODY.volume(grid)
    motion = clra.Motion(shift_u=np.full(121, 0.4), shift_v=np.zeros(121))
    moved = BODY.line_integrals(scan.geometry.with_motion(motion))

    def error(pixels, mask=None, corrections=None):
        volume = clra.reconstruct(
            clra.Scan(pixels, scan.geometry, mask=mask),
            method,
            motion=motion,
            corrections=corrections,
        )
        return np.sqrt(np.mean((volume - truth)[10:-10] ** 2))

    spoilt = np.where(mask, moved, 9.0)
    assert error(spoilt, mask=mask) < 1.02 * error(moved)
    assert error(spoilt, corrections=CorrectionOptions.none()) > 1.2 * error(moved)
    # Without a mask the bad pixels are found.
    assert error(spoilt) < 1.02 * error(moved)


def test_aligning_on_the_way_finds_them_out(scan):
    good, bad = (clra.reconstruct(s, align=True) for s in (scan, _spoilt(scan, 9.0)))
    assert np.sqrt(np.mean((bad - good) ** 2)) < 0.05


@pytest.mark.parametrize("value", [0.0, 9.0])
def test_katsevich_puts_what_lies_between_in_place_of_them(scan, value):
    whole = clra.reconstruct(scan, "katsevich")
    spoilt = _spoilt(scan, value)  # 9 at the border would be a sample too wide
    with pytest.warns(UserWarning, match="katsevich needs every view: 3 of 121 that are missing"):
        found = clra.reconstruct(spoilt, "katsevich", valid_views=VALID)
    used = clra.reconstruct(spoilt, "katsevich")

    def rms(volume):
        return np.sqrt(np.mean((volume - whole) ** 2))

    assert rms(found) < 0.05 * rms(used)
    assert rms(found) < 0.001
    missing = clra.Scan(scan.read(0, scan.views)[VALID], scan.geometry.subset(VALID))
    grid = default_grid(scan.geometry)
    with pytest.warns(UserWarning, match="needs every view: 3 of 121"):
        again = clra.reconstruct(missing, "katsevich", grid)
    assert rms(again) == pytest.approx(rms(found), rel=0.01)


def test_katsevich_takes_the_last_of_a_view_that_was_repeated(scan):
    views = np.sort(np.append(np.arange(121), 60))
    twice = clra.Scan(scan.read(0, 121)[views], scan.geometry.subset(views))
    twice.projections[60] = 9.0  # it was taken again because it had failed
    grid = default_grid(scan.geometry)
    expected = clra.reconstruct(scan, "katsevich", grid)
    assert np.abs(clra.reconstruct(twice, "katsevich", grid) - expected).max() < 1e-5
    assert (expected > 0.5).mean() > 0.05


def test_katsevich_says_what_lies_between_the_parts_of_a_broken_helix(scan):
    detector = {"source_to_axis": 4.0, "source_to_detector": 8.0, "pixel_size": 0.06}
    step = math.radians(5.9)
    whole = clra.helix(260, angle_step=step, z_step=0.008, shape=scan.geometry.shape, **detector)
    broken = whole.subset(np.r_[:124, 136:260])
    grid = default_grid(broken)
    with pytest.warns(UserWarning, match=r"2 helices \(views 0 to 123, 124 to 247\)") as said:
        volume = clra.reconstruct(clra.Scan(BODY.line_integrals(broken), broken), "katsevich", grid)
    told = re.search("heights (.*) to (.*) mm", str(said[0].message))
    assert told is not None
    z = grid.coordinates()[2]
    axis = volume[:, grid.shape[1] // 2, grid.shape[2] // 2]
    empty = z[(axis == 0) & (np.abs(z) < 0.5)]
    expected = pytest.approx([empty[0], empty[-1]], abs=2 * grid.voxel_size)
    assert [float(height) for height in told.groups()] == expected


@pytest.mark.parametrize(
    "valid_views", [np.ones(7, np.bool_), np.zeros(121, np.bool_), np.ones(121, np.intp)]
)
def test_choices_that_are_none(scan, valid_views):
    with pytest.raises(ValueError, match="valid_views: found"):
        clra.reconstruct(scan, valid_views=valid_views)
