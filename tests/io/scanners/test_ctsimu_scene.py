"""Coordinate systems of CTSimU scenarios against the authors' own toolbox."""

from pathlib import Path

import numpy as np
import pytest
import vendor_files as vendor
from vendor_files import VIEWS

from clra.io.scanners.ctsimu import _turns
from clra.io.scanners.ctsimu_scene import Json, part_poses

DEVIATIONS = {
    "source": [
        {"type": "translation", "axis": "z", "amount": {"value": 50, "unit": "um"}},
        {
            "type": "translation", "axis": "u",
            "amount": {
                "value": 0, "unit": "mm",
                "drifts": [
                    {"value": [0.0, 0.3, -0.2], "unit": "mm", "known_to_reconstruction": False},
                    {"value": [10, 20], "unit": "um"},
                ],
            },
        },
    ],
    "stage": [
        {
            "type": "rotation", "axis": "u", "amount": {"value": 2, "unit": "deg"},
            "pivot": {
                "x": {"value": 25, "unit": "mm"}, "y": {"value": 1, "unit": "mm"},
                "z": {"value": -2, "unit": "mm"},
            },
        },
        {
            "type": "translation",
            "axis": {"x": {"value": 1}, "y": {"value": 2}, "z": {"value": 2}},
            "known_to_reconstruction": False,
            "amount": {"value": -0.4, "unit": "mm", "drifts": [{"value": [0, 1], "unit": "mm"}]},
        },
    ],
    "detector": [
        {"type": "rotation", "axis": "w", "amount": {"value": 0.02, "unit": "rad"}},
        {
            "type": "rotation", "axis": "y",
            "amount": {
                "value": 0, "unit": "deg",
                "drifts": [{"value": [0, 1, 3], "unit": "deg"}],
            },
        },
    ],
}  # fmt: skip


@pytest.mark.parametrize("known_only", [False, True])
def test_poses_are_those_of_the_toolbox(known_only: bool, tmp_path: Path) -> None:
    scenario = pytest.importorskip("ctsimu.scenario")
    path = vendor.write_ctsimu(tmp_path, None, DEVIATIONS)
    oracle = scenario.Scenario(str(path))
    ours = Json.read(path)
    turns = {"stage": _turns(ours, VIEWS)}
    for name in ("source", "stage", "detector"):
        part = ours.need("geometry", name)
        poses = part_poses(part, turns.get(name, [0.0] * VIEWS), known_only=known_only)
        for frame in (0, 1, 7, VIEWS // 2, VIEWS - 1):
            oracle.set_frame(frame, reconstruction=known_only)
            system = getattr(oracle, name).coordinate_system
            theirs = [[v.x(), v.y(), v.z()] for v in (system.center, system.u, system.v, system.w)]
            found = [poses[frame].centre, *poses[frame].axes]
            np.testing.assert_allclose(found, theirs, atol=1e-9, err_msg=f"{name} {frame}")
