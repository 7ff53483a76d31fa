"""Region, voxel, binning and window of a reconstruction."""

import numpy as np
import pytest

import clra
from clra.model.binning import binned_scan
from clra.model.corrections.correction_options import CorrectionOptions
from clra.model.grid import default_grid, volume_grid
from clra.model.phantoms.ellipsoids import Ellipsoids

DETECTOR = {
    "source_to_axis": 50.0,
    "source_to_detector": 100.0,
    "pixel_size": 1.0,
    "shape": (25, 48),
}
BODY = Ellipsoids([(4, -2, 0), (-5, 3, 1)], [(5, 3, 3), (1.5, 4, 2)], [0.1, 0.2])


@pytest.fixture(scope="module")
def scan():
    geometry = clra.circular(90, **DETECTOR)
    return clra.Scan(BODY.line_integrals(geometry, oversample=2), geometry)


def test_a_region_is_cut_from_the_whole_volume(scan):
    whole = clra.reconstruct(scan)
    roi = ((0.4, 9.1), (-6.0, 3.0), (-1.0, 2.2))
    part = clra.reconstruct(scan, roi=roi)
    grid, all_of_it = volume_grid(scan.geometry, roi=roi), default_grid(scan.geometry)
    first = [
        int(np.abs(axis - a[0]).argmin())
        for axis, a in zip(all_of_it.coordinates(), grid.coordinates(), strict=True)
    ]
    x, y, z = first
    nz, ny, nx = grid.shape
    cut = whole[z : z + nz, y : y + ny, x : x + nx]
    # W is interpolated from other coarse voxels.
    assert np.abs(part - cut).max() < 0.02 * whole.max()


def test_binning_absorbs_the_motion_first(scan):
    rng = np.random.default_rng(0)
    motion = clra.Motion(shift_u=rng.normal(size=90), shift_v=rng.normal(size=90))
    moved = clra.Scan(
        BODY.line_integrals(scan.geometry.with_motion(motion), oversample=2), scan.geometry
    )
    still = clra.reconstruct(binned_scan(scan, 2))
    found = clra.reconstruct(moved, motion=motion, binning=2)
    without = clra.reconstruct(moved, binning=2)
    assert found.shape == still.shape == default_grid(scan.geometry.binned(2)).shape
    assert np.abs(found - still).std() < 0.5 * np.abs(without - still).std()


def test_a_voxel_of_another_size(scan):
    volume = clra.reconstruct(scan, voxel_size=0.37)
    grid = volume_grid(scan.geometry, voxel_size=0.37)
    assert volume.shape == grid.shape
    x, y, _ = grid.coordinates()
    inside = np.hypot(y[:, None] + 2, x - 4) < 1.5
    assert volume[grid.shape[0] // 2][inside].mean() == pytest.approx(0.1, rel=0.02)


def test_windows_trade_noise(scan):
    rng = np.random.default_rng(1)
    pixels = rng.normal(size=scan.shape).astype(np.float32)
    pixels[:, :, [0, 1, -2, -1]] = 0  # no sample at the border
    noise = clra.Scan(pixels, scan.geometry)
    # Noise alone has nothing that is air.
    as_it_is = CorrectionOptions(intensity=False, bad_pixels=False, zingers=False)
    sigma = {
        window: clra.reconstruct(noise, window=window, corrections=as_it_is).std()
        for window in ("ram-lak", "shepp-logan", "hann")
    }
    assert sigma["hann"] < 0.6 * sigma["shepp-logan"] < 0.6 * sigma["ram-lak"]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"window": "hamming"}, "window: found 'hamming', expected one of"),
        ({"window": "hann", "method": "osem-tr"}, "expected one of .* with method 'fbp'"),
        ({"binning": 2, "method": "imgr", "align": True}, "binning: found 2 where imgr aligns"),
        ({"binning": 99}, "factor: found 99, expected at most 25"),
    ],
)
def test_options_that_do_not_fit(scan, options, message):
    with pytest.raises(clra.InputError, match=message):
        clra.reconstruct(scan, **options)
