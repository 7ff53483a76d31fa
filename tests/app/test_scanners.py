"""Scanners' files through the commands: the same volume as from NXtomo, and what is told."""

import json
import struct
from pathlib import Path

import numpy as np
import pytest
import vendor_files as vendor
from vendor_files import DEGREES, SHAPE, VIEWS

from clra import Scan, read_alignment, reconstruct
from clra.app.simulation import sample, simulated_motion, simulated_scan
from clra.io.scan_files import import_scanner, read_scan, write_scan
from clra.io.scanners.recognise import read_scanner, read_start_motion
from clra.io.scanners.scanner_options import ScannerOptions
from clra.io.scanners.scanner_scan import ScannerScan
from clra.model.grid import default_grid
from clra.model.motion import Motion

CONE = {"source_distance": 30.0, "detector_distance": 90.0, "pixel_size": 0.4}
# A count of 50000 in line integrals of up to about 1, times the ramp's gain.
COUNTS = 1e-5


def circle() -> np.ndarray:
    """Vectors of the frames of a circle, rows from the top down."""
    from clra.io.nxtomo.geometry_fields import Fields

    ones = np.ones(VIEWS)
    fields = Fields(
        angle=np.deg2rad(DEGREES), translation=np.zeros((VIEWS, 3)), source_distance=30 * ones,
        detector_distance=90 * ones, pixel=(0.4, 0.4),
    )  # fmt: skip
    return fields.geometry(SHAPE).to_astra()


WRITERS = {
    "nikon": (vendor.write_nikon, {}),
    "skyscan": (vendor.write_skyscan, {}),
    "phoenix": (vendor.write_phoenix, {}),
    "tescan": (vendor.write_tescan, {}),
    "zeiss": (vendor.write_zeiss, {}),
    "dxchange": (vendor.write_dxchange, CONE),
    "heliscan": (
        vendor.write_heliscan,
        {"angles": DEGREES, "shape": SHAPE, "z_translation": 0 * DEGREES},
    ),
    "ctsimu": (vendor.write_ctsimu, {}),
    "geom": (lambda folder, frames: vendor.write_geom(folder, frames, circle()), {"shape": SHAPE}),
}


def simulated(metadata: ScannerScan, motion: Motion | None = None) -> np.ndarray:
    """Line integrals of spheres that the scan of some metadata would have seen."""
    geometry = metadata.geometry
    still = Motion.identity(geometry.views)
    return simulated_scan(geometry, sample("spheres", geometry), motion or still).read(0, VIEWS)


@pytest.mark.parametrize("name", WRITERS)
def test_the_same_volume_as_from_nxtomo(name: str, tmp_path: Path) -> None:
    if name == "zeiss":
        pytest.importorskip("olefile")
    write, given = WRITERS[name]
    options = ScannerOptions(**given)
    for folder in ("metadata", "scan"):
        (tmp_path / folder).mkdir()
    metadata = read_scanner(write(tmp_path / "metadata", None), options)
    lines = simulated(metadata)
    path = write(tmp_path / "scan", np.exp(-lines))
    direct = read_scan(path, options=options)
    import_scanner(tmp_path / "counts.nxs", read_scanner(path, options))
    truth = Scan(lines, metadata.geometry)
    write_scan(tmp_path / "truth.nxs", truth)
    found = reconstruct(direct)
    for other in ("counts.nxs", "truth.nxs"):
        volume = reconstruct(read_scan(tmp_path / other))
        error = np.abs(volume - found).max() / np.abs(volume).max()
        # The truth is not counted in whole numbers.
        assert error < (1e-5 if other == "counts.nxs" else 2e-3), (other, error)
    phantom = sample("spheres", metadata.geometry).volume(default_grid(metadata.geometry))
    assert np.corrcoef(found.ravel(), phantom.ravel())[0, 1] > 0.8


def test_import_and_info_tell_what_was_read(tmp_path: Path, clra) -> None:
    metadata = read_scanner(vendor.write_tescan(tmp_path, None))
    path = vendor.write_tescan(tmp_path, np.exp(-simulated(metadata)))
    code, out, err = clra("info", path)
    assert code == 0, err
    for part in (
        "distances:", "source to axis 30 mm, to detector 120 mm", "magnification: 4",
        "voxels of 100 um", "FleX-ray / TESCAN, scan settings.txt",
        "counts, 2 flats, 1 flats after, 2 darks",
        "note: sign not verified on a real scan: angles turn counter-clockwise seen from above: "
        "--rotation cw turns it",
    ):  # fmt: skip
        assert part in out
    code, out, err = clra("import", tmp_path, "-o", tmp_path / "scan.nxs", "--json")
    told = json.loads(out)
    assert code == 0 and told["scan"]["views"] == VIEWS, err
    assert told["scanner"]["COR"] == "16.25"
    assert {f["code"] for f in told["scanner"]["findings"]} == {"unverified-sign"}
    turned = tmp_path / "turned.nxs"
    assert clra("import", path, "-o", turned, "--rotation", "cw", "--quiet")[0] == 0
    assert read_scan(turned).geometry != read_scan(tmp_path / "scan.nxs").geometry


def test_info_of_metadata_alone(tmp_path: Path, clra) -> None:
    code, out, err = clra("info", vendor.write_nikon(tmp_path, None))
    assert code == 0, err
    assert "radiographs: none beside the metadata" in " ".join(out.split())
    code, out, err = clra("align", tmp_path, "-o", tmp_path / "motion.h5")
    assert code == 2 and "radiographs: found none, expected Lego_0001.tif" in err


def test_wrong_things_to_import(tmp_path: Path, clra) -> None:
    path = vendor.write_skyscan(tmp_path, np.full((VIEWS, *SHAPE), 0.5))
    out = tmp_path / "scan.nxs"
    for options, part in (
        ([path, "--flat", "flat.tif"], "found frames, expected none: they come from the scan"),
        ([path, "--kind", "transmission"], "--kind: found transmission, expected none: its meta"),
        ([path, "--dtype", "float32"], "--dtype: found float32, expected none: its metadata tell"),
        ([path, "--byteorder", "big"], "--byteorder: found big, expected none: its metadata tell"),
        ([path, "--header", 0], "--header: found 0, expected none: its metadata tell it"),
        ([path, "--rotation", "left"], "--rotation: rotation: found 'left', expected ccw or cw"),
        ([path, "--flip", "sideways"], "--flip: flip: found 'sideways', expected one of columns"),
        ([path, "--centre-offset", "1,2,3"], "expected COLUMN or COLUMN,ROW"),
        ([tmp_path / "bone_0000.tif"], "clra import makes one of frames and a table of angles"),
        ([tmp_path / "bone_0000.tif", "--angles", "0:0:1"], "--pixel-size: found nothing"),
    ):
        code, _, err = clra("import", *options, "-o", out)
        assert code == 2 and part in err and err.count("\n") == 1, err
    assert not out.exists()


def test_alignment_starts_from_the_vendors_motion(tmp_path: Path, clra) -> None:
    pytest.importorskip("olefile")
    metadata = read_scanner(vendor.write_zeiss(tmp_path, None))
    truth = simulated_motion("random", metadata.geometry, shift=(-2.0, 2.0), magnification=0.0)
    lines = simulated(metadata, truth)
    path = vendor.write_zeiss(tmp_path, np.exp(-lines), (-truth.shift_u, truth.shift_v))
    start = read_start_motion(path, VIEWS)
    np.testing.assert_allclose(start.shift_v, truth.shift_v, atol=1e-6)
    # Sharper with the motion than without: its sign is that of the reconstruction.
    scan = read_scan(path)
    still = reconstruct(Scan(simulated(metadata), scan.geometry))
    errors = [
        np.linalg.norm(reconstruct(scan, motion=motion) - still)
        for motion in (start, start.inverse(), None)
    ]
    assert errors[0] < 0.7 * min(errors[1:])
    out = tmp_path / "motion.h5"
    code, _, err = clra(
        "align", path, "-o", out, "--start", path, "--schedule", "1FR", "--estimate", "shift", "-q"
    )
    assert code == 0, err
    found = read_alignment(out).motion
    assert np.abs(found.shift_u - truth.shift_u).mean() < 0.5
    code, _, err = clra("align", path, "-o", out, "--start", tmp_path / "no.pcr")
    assert code == 2 and "no.pcr" in err


def test_tetrahedron_of_another_simulator(data: Path) -> None:
    # Of all mirror images and turns the scan is of the one that its scenario says.
    folder = data / "ctsimu_tetrahedron"
    scan = read_scan(folder)
    volume = reconstruct(scan)
    raw = (folder / "tetra.stl").read_bytes()
    (count,) = struct.unpack("<I", raw[80:84])
    record = np.dtype([("normal", "<3f4"), ("corners", "<9f4"), ("rest", "<u2")])
    corners = np.frombuffer(raw, record, count, 84)["corners"].reshape(-1, 3, 3).astype(float)
    # Its bounding box has its middle where the scenario puts the sample.
    flat = corners.reshape(-1, 3)
    middle = 0.5 * (flat.min(axis=0) + flat.max(axis=0))
    places = corners.mean(axis=1) - middle + [9.428083, 0, 8.888888]
    voxel = default_grid(scan.geometry).voxel_size

    def inside(points: np.ndarray) -> float:
        index = np.rint(points[:, ::-1] / voxel + (np.array(volume.shape) - 1) / 2).astype(int)
        return float(volume[tuple(index.T)].mean())

    right = inside(places)
    # It is its own mirror image in y.
    for signs in ((-1, 1, 1), (1, 1, -1), (-1, 1, -1)):
        assert inside(places * signs) < 0.5 * right, signs
    assert inside(places[:, [1, 0, 2]]) < 0.5 * right


def test_a_tooth(data: Path) -> None:
    path = data / "dxchange" / "tooth.h5"
    volume = reconstruct(read_scan(path, parallel=True, centre_offset=-24.0))[0]
    row, column = np.indices(volume.shape) - (volume.shape[0] - 1) / 2
    radius = np.hypot(row, column)
    tooth, air = volume[radius < 100], volume[(radius > 180) & (radius < 280)]
    # Enamel of about 7/mm in air of nothing, where a pixel is a micrometre.
    assert np.percentile(tooth, 90) > 6
    assert abs(np.median(air)) < 0.05 * np.percentile(tooth, 90)
    misplaced = reconstruct(read_scan(path, parallel=True, centre_offset=-19.0))[0]
    assert -misplaced[misplaced < 0].sum() > 1.15 * -volume[volume < 0].sum()
