import dataclasses

import h5py
import numpy as np

from clra.app.records import Record
from clra.app.report.summary import summary_of
from clra.io.motion_file import write_motion_file
from clra.io.scan_files import scan_checksum
from clra.model.motion import Motion


def test_a_record_survives_its_file(record, scan, motion_file):
    loaded = Record.load(motion_file)
    assert loaded.motion == record.motion
    np.testing.assert_array_equal(loaded.confidence, record.confidence)
    assert loaded.flagged == record.flagged
    assert loaded.history == record.history
    assert loaded.gauge == record.gauge and loaded.sigma == record.sigma
    assert {**record.about, "version": loaded.about["version"]} == loaded.about
    assert loaded.about["checksum"] == scan_checksum(scan)


def test_how_far_the_source_went_is_remembered_and_told(result, scan, tmp_path):
    geometry = scan.geometry
    pitch = np.linalg.norm(geometry.u[0])
    magnified = geometry.source_to_detector[0] / geometry.source_to_axis[0]
    drift = np.linspace(0, 3, scan.views)  # pixel
    motion = Motion(shift_u=drift, shift_v=2 * drift, cause="source")
    record = Record.of(dataclasses.replace(result, motion=motion), scan)
    record.save(tmp_path / "motion.h5")
    text = summary_of(Record.load(tmp_path / "motion.h5"), None)[1]
    across = 1e3 * 3 * pitch / (magnified - 1)
    assert f"{across:.3g}, {2 * across:.3g}, " in text
    assert "source_travel" not in summary_of(Record.of(result, scan), None)[0]


def test_flagged_views_are_not_valid_views(record):
    assert record.flagged == (3, 17)
    assert np.flatnonzero(~record.valid_views).tolist() == [3, 17]
    assert record.scale_estimated


def test_the_file_is_the_one_that_others_read(motion_file, record):
    with h5py.File(motion_file) as file:
        np.testing.assert_array_equal(file["motion/shift_u"], record.motion.shift_u)
        assert file["motion/shift_u"].attrs["units"] == "pixel"
        assert list(file["history/level"].asstr()) == ["QR", "HR"]
        assert file.attrs["schedule"] == "1QR-1HR"


def test_a_history_without_what_may_be_missing_is_read(motion_file, record):
    with h5py.File(motion_file, "a") as file:
        del file["history/note"], file["history/misfit"]
    loaded = Record.load(motion_file)
    assert [dataclasses.replace(step, note="") for step in record.history] == [*loaded.history]
    assert record.notes == ("few features", "3 < 4 views") and loaded.notes == ()
    with h5py.File(motion_file, "a") as file:
        del file["history/residual"]
    assert Record.load(motion_file).history == ()


def test_a_file_of_shifts_alone_is_enough(record, tmp_path):
    write_motion_file(tmp_path / "bare.h5", record.motion)
    bare = Record.load(tmp_path / "bare.h5")
    assert bare.motion == record.motion
    assert bare.history == () and bare.gauge == {} and bare.sigma is None
    assert bare.flagged == () and bare.valid_views.all()
