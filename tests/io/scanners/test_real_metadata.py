"""Real files of scanners, as a person reads them; skipped without them."""

from pathlib import Path

import numpy as np
import pytest

from clra.io.scan_files import read_scan
from clra.io.scanners.recognise import read_scanner, read_start_motion
from clra.io.scanners.scanner_scan import ScannerScan
from clra.model.grid import default_grid


def numbers(scan: ScannerScan) -> tuple[float, float, float]:
    """Distances to axis and detector, and voxel of the default grid [mm]."""
    g = scan.geometry
    return (
        float(np.median(g.source_to_axis)),
        float(np.median(g.source_to_detector)),
        default_grid(g).voxel_size,
    )


def test_nikon(data: Path) -> None:
    scan = read_scanner(data / "scanners" / "nikon")
    assert scan.geometry.to_astra().shape == (1570, 12) and scan.geometry.shape == (1000, 1000)
    np.testing.assert_allclose(numbers(scan), (33.97571, 679.5143, 0.02), rtol=1e-5)
    assert scan.white == 58500 and scan.kind == "transmission" and scan.missing
    # ObjectOffsetX of -0.0277 mm, 20 times as large on pixels of 0.4 mm, columns to the left.
    seen = scan.geometry.project([[0.0, 0.0, 0.0]])[:, 0, 0]
    np.testing.assert_allclose(seen, 499.5 + 0.0277442 * 20 / 0.4, atol=2e-3)
    # _ctdata.txt: the first view is at 0.0342, the last at 360.8379 degrees.
    angle = np.unwrap(np.arctan2(scan.geometry.u[:, 1], scan.geometry.u[:, 0]))
    assert np.rad2deg(angle[-1] - angle[0]) == pytest.approx(360.8379 - 0.0342, abs=1e-4)
    assert scan.details["tube"] == "90 kV, 32 uA"


def test_skyscan(data: Path) -> None:
    scan = read_scanner(data / "scanners" / "skyscan_1173")
    assert scan.geometry.views == 1200 and scan.geometry.shape == (2240, 2240)
    np.testing.assert_allclose(numbers(scan), (197.738, 364.0, 0.026844857), rtol=1e-7)
    # The log's own fan angle is that of the pixel which was worked out.
    width = 2240 * np.linalg.norm(scan.geometry.u[0])
    fan = 2 * np.rad2deg(np.arctan(0.5 * width / 364.0))
    assert fan == pytest.approx(17.291304, abs=2e-6)
    np.testing.assert_allclose(scan.geometry.principal[:, 1], 1088)
    told = " ".join(map(str, scan.findings))
    assert "CameraXYRatio 1.074" in told and "--centre-offset 0.5 or -0.5" in told


def test_phoenix(data: Path) -> None:
    scan = read_scanner(data / "scanners" / "ge")
    # 1301 rows of .pcp for 1300 images: the last stands where the first does.
    assert scan.geometry.views == 1300 and scan.geometry.shape == (2024, 2014)
    np.testing.assert_allclose(numbers(scan), (41.52975, 807.1353464, 0.01029065), rtol=1e-6)
    np.testing.assert_allclose(scan.geometry.principal[0], (1006.5, 1011.5))
    np.testing.assert_allclose(scan.white[:3], (3151.3, 3153.1, 3152.6))
    motion = read_start_motion(data / "scanners" / "ge" / "FEG230530_409.pcr", 1300)
    assert (motion.shift_u.min(), motion.shift_u.max()) == (-1.1, 0.5)
    assert motion.magnification.max() == 1.0008 and motion.shift_v.min() == -0.2
    assert motion.shift_u[162 - 1] == -0.2 and motion.shift_u[0] == 0


def test_tescan(data: Path) -> None:
    scan = read_scanner(data / "scanners" / "tescan")
    assert scan.geometry.views == 1440 and scan.geometry.shape == (948, 960)
    np.testing.assert_allclose(numbers(scan), (149.99997, 599.999432, 0.075000056), rtol=1e-6)
    assert scan.details["Scanner name"] == "UniTOM XL WMG"


def test_zeiss(data: Path) -> None:
    pytest.importorskip("olefile")
    scan = read_scanner(data / "zeiss" / "test_chip_tomo.txrm")
    assert scan.frames.shape == (7, 256, 256) and scan.frames.dtype == np.uint16
    assert numbers(scan)[2] == pytest.approx(0.15578948e-3)
    # Seen by hand: 1 to 476 counts, the bright spot of the condenser in the middle.
    frames = scan.frames[0:7]
    assert (frames.min(), frames.max()) == (1, 476)
    row, column = np.unravel_index(np.argmax(frames[3]), (256, 256))
    assert abs(row - 128) < 20 and abs(column - 128) < 20
    np.testing.assert_allclose(
        scan.start_motion.shift_u[:3], (-0.259159, 0.943685, -1.280618), 1e-5
    )


def test_data_exchange(data: Path) -> None:
    scan = read_scan(data / "dxchange" / "tooth.h5", parallel=True, centre_offset=-24.0)
    assert scan.shape == (181, 2, 640)
    lines = scan.read(0, 181)
    # Half a turn apart, radiographs are each other's mirror images about the axis' column.
    opposite = lines[180][:, ::-1]
    np.testing.assert_allclose(lines[0][:, :592], opposite[:, 48:], atol=0.25)
    assert np.abs(lines[0][:, :592] - opposite[:, 48:]).mean() < 0.02


def test_ctsimu(data: Path) -> None:
    scan = read_scanner(data / "ctsimu_tetrahedron")
    assert scan.flats.shape[0] == 3 and scan.darks.shape[0] == 1
    # 21 radiographs over a whole turn, both ends included.
    assert scan.frames.shape == (20, 150, 150)
    np.testing.assert_allclose(numbers(scan), (300, 400, 0.975))
