"""Defects of whole scans: found, corrected, and no harm done where there are none."""

import numpy as np
import pytest

import clra
from clra.app.simulation import counted, paper_like, sample, simulated_motion
from clra.errors import InputError
from clra.findings import collected
from clra.io.frames.frame_import import import_frames
from clra.methods.preparation import prepared, used_views
from clra.model.corrections.correction_options import CorrectionOptions

VIEWS, SHAPE = 90, (80, 96)
# Mean absolute errors that defects may add [pixel]; measured: 0.003.
ADDED = 0.006


@pytest.fixture(scope="module")
def clean():
    geometry = paper_like("helix", VIEWS, SHAPE)
    truth = simulated_motion("random", geometry, shift=(-4, 4), seed=81)
    images = sample("porous", geometry, 81).line_integrals(geometry.with_motion(truth))
    noisy = [counted(image, 20000, seed=(81, view)) for view, image in enumerate(images)]
    return clra.Scan(np.stack(noisy), geometry, truth=truth)


@pytest.fixture(scope="module")
def aligned(clean):
    return clra.align(clean)


def spoilt(scan, images):
    return clra.Scan(images, scan.geometry, truth=scan.truth)


def error(result, scan):
    last = result.history[-1]
    return np.array([last.gauge_free_u, last.gauge_free_v])


@pytest.fixture(scope="module")
def bad():
    random = np.random.default_rng(17)
    bad = random.random(SHAPE) < 0.005
    bad[:, [21, 50, 51]] = True
    return bad


@pytest.fixture(scope="module")
def defective(clean, bad):
    """Hot and dead pixels that the flats do not have, and dead columns."""
    images = clean.read(0, VIEWS).copy()
    images[:, bad] = 9.0
    images[:, bad & (np.arange(SHAPE[0]) % 2 > 0)[:, None]] = -1.5
    return spoilt(clean, images)


def test_bad_pixels_do_not_hold_an_alignment(clean, aligned, defective, bad):
    found = clra.align(defective)
    assert (error(found, clean) < error(aligned, clean) + ADDED).all()
    (finding,) = (f for f in found.warnings if f.code == "bad-pixels")
    assert finding.measured["bad_pixels"] == bad.sum()
    assert finding.measured["columns"] == "21 50 51"
    off = clra.align(defective, corrections=CorrectionOptions.none())
    assert error(off, clean)[0] > 10 * error(aligned, clean)[0]


def test_bad_pixels_do_not_show_in_a_volume(clean, aligned, defective):
    expected = clra.reconstruct(clean, motion=aligned.motion)
    found = clra.reconstruct(defective, motion=aligned.motion)
    assert np.corrcoef(expected.ravel(), found.ravel())[0, 1] > 0.995
    off = clra.reconstruct(defective, motion=aligned.motion, corrections=CorrectionOptions.none())
    assert np.corrcoef(expected.ravel(), off.ravel())[0, 1] < 0.9


def test_a_beam_that_decays_costs_nothing(clean, aligned):
    lost = -np.log(1 - 0.3 * np.arange(VIEWS) / VIEWS).astype(np.float32)
    found = clra.align(spoilt(clean, clean.read(0, VIEWS) + lost[:, None, None]))
    assert (error(found, clean) < error(aligned, clean) + ADDED).all()
    assert "intensity" in {finding.code for finding in found.warnings}


def test_zingers_do_not_show_in_a_volume(clean, aligned):
    random = np.random.default_rng(18)
    images = clean.read(0, VIEWS).copy()
    images[random.random(images.shape) < 3e-4] -= 2.0
    expected = clra.reconstruct(clean, motion=aligned.motion)
    with_and_without = [
        clra.reconstruct(spoilt(clean, images), motion=aligned.motion, corrections=options)
        for options in (None, CorrectionOptions(zingers=False))
    ]
    corrected, off = (np.std(volume - expected) for volume in with_and_without)
    assert corrected < 0.3 * off


def test_rings_are_fainter(clean, aligned):
    gain = np.random.default_rng(19).normal(0, 0.02, SHAPE[1]).astype(np.float32)
    scan = spoilt(clean, clean.read(0, VIEWS) + gain)
    expected = clra.reconstruct(clean, motion=aligned.motion)
    rings, off = (
        np.std(clra.reconstruct(scan, motion=aligned.motion, corrections=options) - expected)
        for options in (CorrectionOptions(rings=True), None)
    )
    assert rings < 0.6 * off


def test_nothing_changes_where_nothing_is_wrong(clean):
    with collected() as findings:
        scan = prepared(clean)
    assert not findings
    assert scan.corrections.bad is None and scan.corrections.air is None
    np.testing.assert_array_equal(scan.read(3, 9), clean.read(3, 9))


def test_a_prepared_scan_is_not_looked_at_again(defective):
    scan = prepared(defective)
    with collected() as findings:
        assert prepared(scan, CorrectionOptions.none()) is scan
    assert [finding.code for finding in findings] == ["bad-pixels"]
    part = scan.subset(slice(4, 9))
    np.testing.assert_array_equal(part.read(0, 5), scan.read(4, 9))


def test_excluded_views_are_not_used(clean):
    images = clean.read(0, VIEWS).copy()
    images[[7, 30]] = images[60]  # wrong, but good radiographs
    options = CorrectionOptions(exclude=(7, 30))
    found = clra.align(spoilt(clean, images), schedule="1QR", corrections=options)
    assert found.flagged == (7, 30)
    reasons = [f.measured for f in found.warnings if f.code == "rejected-views"]
    assert reasons == [{"views": "7 30", "reason": "excluded by the user"}]
    valid = np.arange(VIEWS) != 7
    valid[30] = False
    one, other = (
        clra.reconstruct(clean, valid_views=which, corrections=options) for which in (None, valid)
    )
    np.testing.assert_array_equal(one, other)
    assert used_views(prepared(clean, options), np.arange(VIEWS) > 5).sum() == VIEWS - 8


def test_views_that_are_not_there_cannot_be_excluded(clean):
    with pytest.raises(InputError, match="exclude: found view 90, expected some of 90 views"):
        prepared(clean, CorrectionOptions(exclude=(3, 90)))


def test_a_pattern_over_much_of_the_detector_is_left_alone(clean):
    images = clean.read(0, VIEWS).copy()
    images[:, :, 2::4] = 1.0
    with pytest.warns(UserWarning, match="24% of the pixels seem to show nothing"):
        assert prepared(spoilt(clean, images)).corrections.bad is None


def test_real_scans_keep_their_good_pixels(data, tmp_path):
    """The detectors of these scans were corrected before they were published."""
    folder = data / "dls_24737" / "image_test"
    import_frames(
        tmp_path / "dls.nxs",
        str(folder / "tiffs" / "*.tiff"),
        "-88.2:91.8:91",
        parallel=True,
        pixel_size=1.0,
        centre_offset=6.25,
        flats=folder / "flat_00001.tiff",
        darks=folder / "dark_00001.tiff",
    )
    folder = data / "ctsimu_tetrahedron"
    import_frames(
        tmp_path / "tetrahedron.nxs",
        folder / "tetra_projections.raw",
        "0:360:21",
        source_distance=300.0,
        detector_distance=100.0,
        pixel_size=1.3,
        shape=(150, 150),
        flats=[folder / f"tetra_flat_{k:04d}.raw" for k in range(3)],
        darks=folder / "tetra_dark.raw",
    )
    for name in ("dls", "tetrahedron"):
        scan = clra.read_scan(tmp_path / f"{name}.nxs")
        assert prepared(scan).corrections.bad is None
