import dataclasses

import numpy as np

from clra.app.annotations import annotated
from clra.app.report.summary import summary_of
from clra.io.alignment_file import read_alignment, write_alignment
from clra.model.motion import Motion


def test_the_history_and_the_detector_of_the_run_before_are_carried_on(result, scan):
    earlier = dataclasses.replace(result, about={"detector_tilt": "1 degree", "geometry": "x"})
    later = annotated(result, scan, earlier, command="clra align", geometry="y")
    assert later.history == 2 * result.history
    assert later.about["detector_tilt"] == "1 degree" and later.about["geometry"] == "y"
    assert later.about["path"] == "space-filling" and later.command == "clra align"


def test_how_far_the_source_went_is_remembered_and_told(result, scan, tmp_path):
    geometry = scan.geometry
    pitch = np.linalg.norm(geometry.u[0])
    magnified = geometry.source_to_detector[0] / geometry.source_to_axis[0]
    drift = np.linspace(0, 3, scan.views)  # pixel
    motion = Motion(shift_u=drift, shift_v=2 * drift, cause="source")
    moved = annotated(dataclasses.replace(result, motion=motion), scan)
    write_alignment(tmp_path / "motion.h5", moved)
    text = summary_of(read_alignment(tmp_path / "motion.h5"), None)[1]
    across = 1e3 * 3 * pitch / (magnified - 1)
    assert f"{across:.3g}, {2 * across:.3g}, " in text
    assert "source_travel" not in summary_of(annotated(result, scan), None)[0]
