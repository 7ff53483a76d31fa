"""What Nikon's files leave to choice: sources of angles, old and new keys of the axis."""

from pathlib import Path

import numpy as np
import pytest
import vendor_files as vendor
from vendor_files import DEGREES, FAR, NEAR, PIXEL, SHAPE, VIEWS

from clra.io.scanners.recognise import read_scanner
from clra.model.geometry import ConeBeamGeometry


def turned(geometry: ConeBeamGeometry) -> np.ndarray:
    """Angle of each view from the first [degree]; positive clockwise seen from above."""
    angle = np.unwrap(np.arctan2(geometry.u[:, 1], geometry.u[:, 0]))
    return np.rad2deg(angle - angle[0])


def replaced(path: Path, key: str, *lines: str) -> None:
    kept = [line for line in path.read_text().splitlines() if not line.startswith(f"{key}=")]
    path.write_text("\n".join([*kept, *lines]))


def test_angles_of_the_stage_are_preferred_to_even_steps(tmp_path: Path) -> None:
    path = vendor.write_nikon(tmp_path, None)
    scan = read_scanner(path)
    np.testing.assert_allclose(turned(scan.geometry), DEGREES - DEGREES[0], atol=1e-3)
    told = next(finding for finding in scan.findings if finding.code == "angles")
    assert told.measured["degrees"] == pytest.approx(2.0, abs=0.01)
    (tmp_path / "_ctdata.txt").unlink()
    np.testing.assert_allclose(
        turned(read_scanner(path).geometry), 15.0 * np.arange(VIEWS), atol=1e-9
    )
    table = [f"{k + 1}:\t{angle:.4f}" for k, angle in enumerate(DEGREES)]
    (tmp_path / "Lego.ang").write_text("\n".join(["Proj\tAngle(deg)", *table[::-1]]))
    np.testing.assert_allclose(turned(read_scanner(path).geometry), DEGREES - DEGREES[0], atol=1e-3)


def test_old_files_tell_the_axis_at_both_edges(tmp_path: Path) -> None:
    path = vendor.write_nikon(tmp_path, None)
    new = read_scanner(path)
    offset = vendor.AXIS * PIXEL
    replaced(
        path, "ObjectOffsetX", f"CentreOfRotationTop={offset}", f"CentreOfRotationBottom={offset}"
    )
    replaced(path, "ObjectRoll")
    np.testing.assert_allclose(
        read_scanner(path).geometry.to_astra(), new.geometry.to_astra(), atol=1e-12
    )


def test_roll_leans_the_axis_to_the_right_at_its_top(tmp_path: Path) -> None:
    path = vendor.write_nikon(tmp_path, None)
    replaced(path, "ObjectRoll", "ObjectRoll=2.0")
    geometry = read_scanner(path).geometry
    low, high = (geometry.project([[0.0, 0.0, z]])[:, 0] for z in (-1.0, 1.0))
    lean = np.rad2deg(np.arctan2(high[:, 0] - low[:, 0], low[:, 1] - high[:, 1]))
    np.testing.assert_allclose(lean, 2.0, atol=1e-6)
    # On the detector 2 degrees are this far from edge to edge, in the stored columns to the left.
    edge = np.tan(np.deg2rad(2.0)) * SHAPE[0] * PIXEL
    replaced(
        path, "ObjectRoll",
        f"CentreOfRotationTop={vendor.AXIS * PIXEL - edge / 2}",
        f"CentreOfRotationBottom={vendor.AXIS * PIXEL + edge / 2}",
    )  # fmt: skip
    np.testing.assert_allclose(
        read_scanner(path).geometry.to_astra(), geometry.to_astra(), atol=1e-9
    )
    assert FAR > NEAR
