"""Motions that vendors' software measured, against images moved by other programs' means."""

from pathlib import Path

import numpy as np
import pytest
import vendor_files as vendor
from scipy import ndimage
from vendor_files import DEGREES, PIXEL, SHAPE, VIEWS

from clra.errors import InputError
from clra.io.scanners.recognise import read_scanner, read_start_motion
from clra.io.scanners.scanner_options import ScannerOptions
from clra.model.motion import Motion

RANDOM = np.random.default_rng(0)
SHIFT_U, SHIFT_V = RANDOM.integers(-3, 4, (2, VIEWS)).astype(float)


def blob() -> np.ndarray:
    """Transmission of something round in the middle."""
    row, column = np.indices(SHAPE)
    return 1 - 0.7 * np.exp(-(((row - 10.5) / 3) ** 2) - ((column - 14.5) / 4) ** 2)


def moved() -> np.ndarray:
    """It, in each view where the motion puts it: toward higher columns, and down."""
    return np.stack(
        [
            ndimage.shift(blob(), (v, u), order=1, mode="nearest")
            for u, v in zip(SHIFT_U, SHIFT_V, strict=True)
        ]
    )


def test_zeiss_shifts_move_stored_radiographs_back(tmp_path: Path) -> None:
    pytest.importorskip("olefile")
    # Stored from the bottom up, a radiograph that lies lower lies at lower rows.
    shifts = (-SHIFT_U, SHIFT_V)
    frames = moved()
    for image, x, y in zip(frames[:, ::-1], *shifts, strict=True):
        back = ndimage.shift(image, (y, x), order=1, mode="nearest")
        np.testing.assert_allclose(back[5:-5, 5:-5], blob()[::-1][5:-5, 5:-5], atol=1e-6)
    path = vendor.write_zeiss(tmp_path, frames, shifts)
    assert read_start_motion(path, VIEWS) == Motion(shift_u=SHIFT_U, shift_v=SHIFT_V)
    # That is the motion of the radiographs as they are read.
    found = read_scanner(path).scan().projections[0:VIEWS]
    np.testing.assert_allclose(found, frames, atol=2e-5)
    turned = read_start_motion(path, VIEWS, ScannerOptions(flip="both"))
    assert turned == Motion(shift_u=-SHIFT_U, shift_v=-SHIFT_V)


def test_zeiss_without_shifts(tmp_path: Path) -> None:
    pytest.importorskip("olefile")
    path = vendor.write_zeiss(tmp_path, None, (np.zeros(VIEWS), np.zeros(VIEWS)))
    with pytest.raises(InputError, match=r"start motion: found none, expected Zeiss \.txrm"):
        read_start_motion(path)


def test_phoenix_points_are_interpolated(tmp_path: Path) -> None:
    path = tmp_path / "fly.pcr"
    path.write_text(
        "[Reconstruction Settings]\nLastImage=24\n[SCO_Values]\nSCO_NumPoints=2\n"
        "SCO_0_Index=9\nSCO_0_Scale=1.0008\nSCO_0_X=-0.8\nSCO_0_Y=0.4\n"
        "SCO_1_Index=25\nSCO_1_Scale=1\nSCO_1_X=0.8\nSCO_1_Y=-0\n"
    )
    motion = read_start_motion(path)
    assert motion.views == VIEWS
    image = np.arange(1, VIEWS + 1)
    rising, falling = np.minimum(image - 1, 8) / 8, np.maximum(image - 9, 0) / 16
    np.testing.assert_allclose(motion.shift_u, -0.8 * rising + 1.6 * falling, atol=1e-12)
    np.testing.assert_allclose(motion.shift_v, 0.4 * (rising - falling), atol=1e-12)
    np.testing.assert_allclose(motion.magnification, 1 + 8e-4 * (rising - falling), atol=1e-12)
    # Beside its .pca it is that scan's.
    vendor.write_phoenix(tmp_path, None)
    assert read_start_motion(path) == motion
    with pytest.raises(InputError, match="start motion: found 24 views, expected 7"):
        read_start_motion(path, 7)
    text = path.read_text()
    path.write_text(text.replace("SCO_1_X", "SCO_1_Z"))
    with pytest.raises(InputError, match=r"fly\.pcr: \[SCO_Values\] SCO_1_X: found nothing"):
        read_start_motion(path)


@pytest.mark.parametrize("header", ["", "File, Y shift, X shift", "vertical;horizontal"])
def test_skyscan_shifts_by_their_headings(header: str, tmp_path: Path) -> None:
    path = vendor.write_skyscan(tmp_path, None)
    columns = {
        "": [np.arange(VIEWS), SHIFT_U, SHIFT_V],
        "File, Y shift, X shift": [np.arange(VIEWS), SHIFT_V, SHIFT_U],
        "vertical;horizontal": [SHIFT_V, SHIFT_U],
    }[header]
    lines = [", ".join(f"{value:g}" for value in row) for row in zip(*columns, strict=True)]
    table = tmp_path / "bone__TS.csv"
    table.write_text("\r\n".join([header, *lines]))
    expected = Motion(shift_u=SHIFT_U, shift_v=SHIFT_V)
    assert read_start_motion(table) == expected
    assert read_scanner(path).start_motion == expected
    table.write_text("\n".join(lines[:-1]))
    with pytest.raises(InputError, match=r"_TS\.csv: rows: found 23, expected 24"):
        read_start_motion(table)


def test_ctsimu_deviations_are_the_known_motion(tmp_path: Path) -> None:
    # The detector slides along its columns and down its rows; what it sees moves the other way.
    sliding = [
        {
            "type": "translation", "axis": axis, "known_to_reconstruction": False,
            "amount": {"value": 0.1, "unit": "mm", "drifts": [{"value": [0.0, far], "unit": "mm"}]},
        }
        for axis, far in (("u", 2.0), ("v", -1.0))
    ]  # fmt: skip
    path = vendor.write_ctsimu(tmp_path, None, {"detector": sliding})
    scan = read_scanner(path)
    part = np.arange(VIEWS) / (VIEWS - 1)
    np.testing.assert_allclose(scan.known_motion.shift_u, -(0.1 + 2.0 * part) / PIXEL, atol=1e-9)
    np.testing.assert_allclose(scan.known_motion.shift_v, -(0.1 - 1.0 * part) / PIXEL, atol=1e-9)
    np.testing.assert_allclose(scan.known_motion.magnification, 1, atol=1e-12)
    assert scan.start_motion == scan.known_motion == scan.scan().truth
    (tmp_path / "still").mkdir()
    still = read_scanner(vendor.write_ctsimu(tmp_path / "still", None))
    assert scan.geometry == still.geometry
    for deviation in sliding:
        deviation["known_to_reconstruction"] = True
    (tmp_path / "known").mkdir()
    known = read_scanner(vendor.write_ctsimu(tmp_path / "known", None, {"detector": sliding}))
    assert known.known_motion is None
    assert known.geometry == still.geometry.with_motion(scan.known_motion) or np.allclose(
        known.geometry.to_astra(), still.geometry.with_motion(scan.known_motion).to_astra()
    )


def test_angles_do_not_matter_here() -> None:
    assert len(DEGREES) == VIEWS
