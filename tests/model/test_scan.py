"""Scans are read lazily, checked, and turned into line integrals."""

import numpy as np
import pytest

from clra.model.motion import Motion
from clra.model.scan import Scan
from clra.model.trajectory import circular

VIEWS, SHAPE = 7, (3, 5)
# float32 rounding of line integrals up to 14.
ROUNDING = 2e-6


@pytest.fixture
def geometry():
    return circular(VIEWS, source_to_axis=10, source_to_detector=20, pixel_size=1, shape=SHAPE)


@pytest.fixture
def lines():
    random = np.random.default_rng(0)
    return random.uniform(0, 3, (VIEWS, *SHAPE)).astype(np.float32)


class Recorder:
    """Projections that remember what was read of them."""

    def __init__(self, array):
        self.array, self.shape, self.read = array, array.shape, []

    def __getitem__(self, views):
        self.read.append((views.start, views.stop))
        return self.array[views]


def test_line_integrals_are_read_as_they_are(geometry, lines):
    scan = Scan(lines, geometry)
    np.testing.assert_array_equal(scan.read(2, 5), lines[2:5])
    assert scan.shape == (VIEWS, *SHAPE)
    assert scan.views == len(scan) == VIEWS
    assert scan.read(3, 3).shape == (0, *SHAPE)


def test_transmission_becomes_line_integrals(geometry, lines):
    transmission = np.exp(-lines.astype(np.float64))
    found = Scan(transmission, geometry, "transmission").read(0, VIEWS)
    assert found.dtype == np.float32
    np.testing.assert_allclose(found, lines, atol=ROUNDING)


def test_dark_pixels_are_cut_off_at_a_millionth(geometry):
    dark = np.zeros((VIEWS, *SHAPE))
    dark[1] = -0.3
    found = Scan(dark, geometry, kind="transmission").read(0, 2)
    np.testing.assert_allclose(found, np.log(1e6), atol=ROUNDING)


@pytest.mark.parametrize("masked", [False, True])
def test_a_sample_too_dense_to_be_seen_through_is_told(geometry, masked):
    transmission = np.full((VIEWS, *SHAPE), 0.5)
    transmission[3, 1, 2] = 0.0  # one pixel of 15
    mask = transmission[3] > 0 if masked else None
    scan = Scan(transmission, geometry, kind="transmission", name="lead", mask=mask)
    scan.read(0, 3)
    if masked:
        scan.read(0, VIEWS)
        return
    with pytest.warns(UserWarning, match="lead: radiographs of which more than 2% is dark"):
        scan.read(0, VIEWS)


def test_reading_gives_contiguous_float32(geometry, lines):
    for array in (np.asfortranarray(lines), lines.astype(np.float64), (lines * 99).astype("u2")):
        found = Scan(array, geometry).read(1, 4)
        assert found.dtype == np.float32
        assert found.flags.c_contiguous


@pytest.mark.parametrize("bad", [np.nan, np.inf])
@pytest.mark.parametrize("kind", ["line-integrals", "transmission"])
def test_pixels_that_are_no_numbers_are_refused_with_their_view(geometry, lines, bad, kind):
    lines[4, 1, 2] = bad
    scan = Scan(lines, geometry, kind, name="rock.nxs")
    scan.read(0, 4)
    with pytest.raises(ValueError, match=r"rock\.nxs: view 4: found a pixel"):
        scan.read(2, 6)


def test_subsets_are_read_in_runs_and_only_when_asked(geometry, lines):
    recorder = Recorder(lines)
    mask = np.ones(SHAPE, bool)
    truth = Motion(shift_u=np.arange(7), shift_v=np.zeros(7))
    chosen = Scan(recorder, geometry, truth=truth, mask=mask).subset([5, 0, 1, 2, 6])
    assert recorder.read == []
    np.testing.assert_array_equal(chosen.read(0, 5), lines[[5, 0, 1, 2, 6]])
    assert recorder.read == [(5, 6), (0, 3), (6, 7)]
    np.testing.assert_array_equal(chosen.truth.shift_u, [5, 0, 1, 2, 6])
    assert chosen.geometry == geometry.subset([5, 0, 1, 2, 6])
    assert chosen.read(2, 2).shape == (0, *SHAPE)
    twice = chosen.subset(slice(None, None, -2))
    np.testing.assert_array_equal(twice.read(0, 3), lines[[6, 1, 5]])


@pytest.mark.parametrize("kind", ["line-integrals", "transmission"])
def test_pixels_that_may_not_be_used_are_filled_from_beside(geometry, kind):
    plane = np.add.outer(np.arange(SHAPE[0]), 10 * np.arange(SHAPE[1])) / 99
    pixels = np.tile(plane if kind == "line-integrals" else np.exp(-plane), (VIEWS, 1, 1))
    mask = np.ones(SHAPE, bool)
    mask[1, 3] = mask[:, 0] = False
    pixels[:4, ~mask], pixels[4:, ~mask] = np.nan, 7.0
    before = pixels.copy()
    found = Scan(pixels, geometry, kind, mask=mask).read(2, 6)
    np.testing.assert_allclose(found[:, mask], np.tile(plane[mask], (4, 1)), atol=ROUNDING)
    np.testing.assert_allclose(found[:, 1, 3], plane[1, 3], atol=ROUNDING)
    np.testing.assert_allclose(found[:, 1, 0], plane[1, 1], atol=ROUNDING)
    np.testing.assert_array_equal(pixels, before)


def test_mask_is_a_copy_of_booleans(geometry, lines):
    mask = np.ones(SHAPE, np.uint8)
    scan = Scan(lines, geometry, mask=mask)
    mask[:] = 0
    assert scan.mask.dtype == bool
    assert scan.mask.all()


def test_repr_names_the_scan(geometry, lines):
    assert repr(Scan(lines, geometry, name="rock")).startswith("Scan('rock', line-integrals, Cone")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"projections": np.zeros((6, 3, 5))}, r"shape \(6, 3, 5\), expected \(7, 3, 5\)"),
        ({"kind": "counts"}, "kind: found 'counts', expected one of"),
        ({"truth": Motion.identity(6)}, "truth: found 6 views, expected 7"),
        ({"mask": np.ones((5, 3))}, r"mask: found shape \(5, 3\) with 15 pixels"),
        ({"mask": np.zeros((3, 5))}, "with 0 pixels to use"),
    ],
)
def test_disagreements_are_refused(geometry, lines, change, message):
    with pytest.raises(ValueError, match=message):
        Scan(**({"projections": lines, "geometry": geometry} | change))


@pytest.mark.parametrize(("start", "stop"), [(-1, 2), (3, 2), (0, 8)])
def test_views_that_are_not_there_are_refused(geometry, lines, start, stop):
    with pytest.raises(ValueError, match=f"views: found {start}:{stop}, expected within 0:7"):
        Scan(lines, geometry).read(start, stop)
