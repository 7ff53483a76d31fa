import numpy as np
import pytest

from clra.errors import InputError
from clra.io.frames.counts import CountedRadiographs

NONE = np.array([], np.intp)


def radiographs(frames: np.ndarray, **changes: object) -> CountedRadiographs:
    """Frame 0 dark, 1 flat, the others radiographs."""
    roles = {"views": np.arange(2, len(frames)), "flats": np.array([1]), "darks": np.array([0])}
    return CountedRadiographs(frames, path="scan.nxs", **{**roles, **changes})


def frames(count: int = 3, shape: tuple[int, int] = (11, 13)) -> np.ndarray:
    counts = np.full((2 + count, *shape), 600.0)
    counts[0], counts[1] = 100.0, 1100.0
    return counts


def test_flats_run_from_group_to_group() -> None:
    counts = np.ones((9, 3, 5))
    flat = {0: 10.0, 1: 20.0, 4: 30.0, 8: 50.0}
    for frame, level in flat.items():
        counts[frame] = level
    views = np.array([2, 3, 5, 6, 7])
    found = CountedRadiographs(
        counts, path="scan.nxs", views=views, flats=np.array(list(flat)), darks=NONE
    )
    # Groups stand at frames 0.5, 4 and 8.
    expected = 1 / np.interp(views, [0.5, 4, 8], [15, 30, 50])
    np.testing.assert_allclose(found[:][:, 1, 2], expected, rtol=1e-6)
    assert found.notes == ("no dark frame: 0 counts taken as dark",)


def test_outside_the_groups_the_nearest_flat_holds() -> None:
    counts = np.ones((5, 3, 5))
    counts[1], counts[3] = 10.0, 20.0
    found = CountedRadiographs(
        counts, path="scan.nxs", views=np.array([0, 4]), flats=np.array([1, 3]), darks=NONE
    )
    np.testing.assert_allclose(found[:][:, 0, 0], [0.1, 0.05], rtol=1e-6)


def test_dead_pixels_are_interpolated() -> None:
    counts = frames()
    ramp = np.arange(13.0)
    counts[2:] = 600 + 10 * ramp
    counts[1, 4, 6] = 90.0
    counts[2:, 4, 6] = 60000.0
    found = radiographs(counts)
    beside = np.sort((500 + 10 * ramp[[5, 5, 5, 6, 6, 7, 7, 7]]) / 1000)
    np.testing.assert_allclose(found[0][4, 6], np.median(beside), rtol=1e-6)
    assert found.notes == (
        "1 bad pixels (saturated or dim in a flat field) interpolated from their neighbours",
    )
    assert found.mask is None


def test_clusters_of_dead_pixels_are_masked() -> None:
    counts = frames()
    counts[1, 2:9, 3:10] = 100.0
    found = radiographs(counts)
    expected = np.ones((11, 13), bool)
    expected[4:7, 5:8] = False  # more than two pixels inside
    np.testing.assert_array_equal(found.mask, expected)
    np.testing.assert_allclose(found[:], 0.5, rtol=1e-6)


def test_a_dead_corner_of_a_tiny_detector() -> None:
    counts = frames(shape=(1, 2))
    counts[1, 0, 0] = 0.0
    np.testing.assert_allclose(radiographs(counts)[:], 0.5, rtol=1e-6)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_pixels_that_are_no_numbers_are_found_when_read(bad: float) -> None:
    counts = frames(4)
    counts[4, 0, :3] = bad
    found = radiographs(counts)
    found[0:2]
    with pytest.raises(InputError, match=r"scan\.nxs: frames: found frame 4 with 3 pixels"):
        found[1:4]


def test_bad_flats_are_found_at_once() -> None:
    counts = frames()
    counts[1, 0, 0] = np.nan
    with pytest.raises(InputError, match="frame 1 with 1 pixels that are no finite numbers"):
        radiographs(counts)


def test_saturated_frames_are_told_of_and_read() -> None:
    counts = frames(4).astype(np.uint16)
    counts[3, 0, :5] = 65535
    found = radiographs(counts)
    with pytest.warns(UserWarning, match="frame 3 with 5 pixels at 65535 counts: saturated"):
        found[0:4]
    found[0:4]  # said once: a second warning would be an error here


def test_pixels_saturated_in_a_flat_are_interpolated() -> None:
    counts = frames(4)
    counts[1, 3, 4] = counts[1, :, 9] = 4095.0
    found = radiographs(counts, saturation=4095.0)
    np.testing.assert_allclose(found[:], 0.5, rtol=1e-6)
    assert found.notes[0].startswith("12 bad pixels")
    counts[1] = 4095.0
    with pytest.raises(InputError, match="flat frame 1 with 143 pixels at 4095"):
        radiographs(counts, saturation=4095.0)


def test_pixels_that_are_dim_in_a_flat_are_interpolated() -> None:
    counts = frames()
    counts[1, 5, 5] = 105.0  # of 1000 above the dark
    counts[2:, 5, 5] = 700.0
    np.testing.assert_allclose(radiographs(counts)[:], 0.5, rtol=1e-6)


def test_a_plateau_below_the_largest_number_is_told_of() -> None:
    random = np.random.default_rng(2)
    counts = random.normal(3900, 150, (5, 40, 40)).round()
    counts[0] = 100
    radiographs(counts)  # noise alone
    with pytest.warns(UserWarning, match=r"flat frame 1 with \d+ pixels at exactly 4000 counts"):
        radiographs(np.minimum(counts, 4000))


def test_normalised_frames_pass_unchanged() -> None:
    pixels = np.random.default_rng(0).random((4, 3, 5)).astype(np.float32)
    found = CountedRadiographs(
        pixels, path="scan.nxs", views=np.arange(4), flats=NONE, darks=NONE, normalised=True
    )
    np.testing.assert_array_equal(found[1:3], pixels[1:3])
    assert found[0:0].shape == (0, 3, 5)
    assert len(found) == 4


def test_frames_that_cannot_be_read() -> None:
    class Broken(np.ndarray):
        def __getitem__(self, index: object) -> np.ndarray:
            raise OSError("inflate() failed")

    found = radiographs(frames())
    found._frames = frames().view(Broken)
    with pytest.raises(InputError, match=r"frames 2 to 4: inflate\(\) failed"):
        found[0:3]
