import math

import numpy as np
import pytest

from clra.app.scan_description import Facts, metric, path_of
from clra.model import trajectory
from clra.model.motion import Motion
from clra.model.scan import Scan

COMMON = dict(source_to_axis=4.0, source_to_detector=400.0, pixel_size=0.5, shape=(7, 9))


@pytest.mark.parametrize(
    ("geometry", "kind"),
    [
        (trajectory.circular(90, **COMMON), "circular"),
        (trajectory.circular(90, arc=-2 * math.pi, **COMMON), "circular"),
        (trajectory.helix(900, angle_step=0.02, z_step=0.003, **COMMON), "helix"),
        (trajectory.helix(900, angle_step=-0.02, z_step=-0.003, **COMMON), "helix"),
        (trajectory.space_filling(901, z_step=0.002, **COMMON), "space-filling"),
        (trajectory.double_helix(300, angle_step=0.05, z_step=0.01, **COMMON), "double helix"),
        (
            trajectory.double_helix(301, angle_step=0.05, z_step=-0.01, second="return", **COMMON),
            "double helix",
        ),
    ],
)
def test_trajectories_are_recognised(geometry, kind):
    assert path_of(geometry).kind == kind


def test_missing_frames_are_forgiven_and_disorder_is_called_so():
    helix = trajectory.helix(400, angle_step=0.02, z_step=0.003, **COMMON)
    kept = np.delete(np.arange(400), [17, 200, 303])
    assert path_of(helix.subset(kept)).kind == "helix"
    shuffled = np.random.default_rng(0).permutation(400)
    assert path_of(helix.subset(shuffled)).kind == "irregular"
    assert path_of(helix.subset([3])).kind == "irregular"


def test_steps_and_pitch_of_the_paper():
    path = path_of(trajectory.helix(3456, angle_step=math.radians(0.5), **trajectory.PAPER))
    assert path.angle_step_deg == pytest.approx(0.5)
    assert path.turns == pytest.approx(4.8)
    assert path.pitch_mm == pytest.approx(1.18152)
    assert path.travel_mm == pytest.approx(3455 * 0.001641)


def test_facts_of_a_scan():
    geometry = trajectory.circular(12, **COMMON)
    scan = Scan(np.zeros((12, 7, 9)), geometry, name="s", truth=Motion.identity(12))
    facts = Facts.of(scan)
    assert facts.magnification == pytest.approx(100)
    assert facts.voxel_mm == pytest.approx(0.005)
    assert facts.fan_angle_deg == pytest.approx(2 * math.degrees(math.atan(4.5 * 0.5 / 400)))
    lines = facts.lines()
    assert lines["scan"] == "s (line-integrals)"
    assert "7 rows x 9 columns" in lines["detector"]
    assert "5 um" in lines["volume"]
    assert "simulation" in lines["known"]
    assert "mm a view" not in lines["trajectory"]  # a circle has no step along z


def test_lengths_have_the_unit_that_suits_them():
    assert [metric(x) for x in (0.004544, 3.2, 436.27, 1e6, 0)] == [
        "4.544 um",
        "3.2 mm",
        "436.3 mm",
        "1000 m",
        "0 mm",
    ]


def test_the_sense_of_turning_is_the_samples():
    """Seen from the source, which goes round the other way than the sample turns."""
    for arc, told in ((1.0, "clockwise"), (-1.0, "counter-clockwise")):
        geometry = trajectory.circular(90, arc=2 * math.pi * arc, **COMMON)
        line = Facts.of(Scan(np.zeros((90, 7, 9)), geometry)).lines()["trajectory"]
        assert line == f"circular, 4 degrees a view, 1 turns of the sample {told} from above"


def test_a_parallel_beam_is_called_so():
    far = COMMON | {"source_to_axis": 1e5, "source_to_detector": 1e5}
    lines = Facts.of(Scan(np.zeros((12, 7, 9)), trajectory.circular(12, **far))).lines()
    assert lines["beam"] == "parallel" and "distances" not in lines
