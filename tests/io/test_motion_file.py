from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np
import pytest

from clra.errors import InputError
from clra.io.motion_file import read_motion_file, write_motion_file
from clra.model.motion import Motion


@dataclass
class Row:
    level: str
    iteration: int
    mae: float | None


@pytest.fixture
def motion() -> Motion:
    rng = np.random.default_rng(0)
    return Motion(
        shift_u=rng.normal(size=9),
        shift_v=rng.normal(size=9),
        magnification=rng.uniform(0.99, 1.01, 9),
    )


def test_what_moved_survives(tmp_path: Path, motion: Motion) -> None:
    path = tmp_path / "motion.h5"
    motion.caused_by("source").save(path)
    assert Motion.load(path) == motion.caused_by("source")
    with h5py.File(path, "r+") as file:
        file["motion"].attrs["cause"] = "stage"
    with pytest.raises(InputError, match="/motion: cause: found 'stage', expected one of"):
        Motion.load(path)
    with h5py.File(path, "r+") as file:
        del file["motion"].attrs["cause"]
    assert Motion.load(path) == motion


def test_everything_survives(tmp_path: Path, motion: Motion) -> None:
    path = tmp_path / "motion.h5"
    confidence = np.linspace(0, 1, 9)
    history = [Row("QR", 1, None), Row("HR", 2, 0.25)]
    write_motion_file(
        path,
        motion,
        confidence=confidence,
        flagged=[0, 7],
        history=history,
        schedule="1QR-1HR",
        device="a device",
        scan="scan.nxs",
        checksum="sha256:0",
        attributes={"estimate": "shift+scale", "seconds": 1.5},
    )
    read = read_motion_file(path)
    assert read.motion == motion
    np.testing.assert_array_equal(read.confidence, confidence)
    assert read.flagged == (0, 7)
    assert read.history["level"].tolist() == ["QR", "HR"]
    assert read.history["iteration"].tolist() == [1, 2]
    np.testing.assert_array_equal(read.history["mae"], [np.nan, 0.25])
    for name, value in {"schedule": "1QR-1HR", "scan": "scan.nxs", "seconds": "1.5"}.items():
        assert read.attributes[name] == value
    assert read.attributes["version"]
    with h5py.File(path) as file:
        assert file["motion/shift_u"].attrs["units"] == "pixel"
        assert file["motion/magnification"].attrs["units"] == "1"
        assert file["motion/confidence"].shape == (9,)


def test_only_shifts_are_needed(tmp_path: Path) -> None:
    path = tmp_path / "motion.h5"
    with h5py.File(path, "w") as file:
        file["motion/shift_u"] = [1, 2]
        file["motion/shift_v"] = [3.0, 4.0]
    read = read_motion_file(path)
    assert read.motion == Motion(shift_u=[1, 2], shift_v=[3, 4])
    assert read.confidence is None
    assert read.flagged == ()
    assert read.history == {}


@pytest.mark.parametrize(
    ("columns", "message"),
    [
        ({"shift_u": [1.0]}, "motion/shift_v: found nothing, expected a motion"),
        ({"shift_u": [1.0, 2], "shift_v": [1.0]}, "shift_v: found 1 values, expected 2"),
        ({"shift_u": [np.nan], "shift_v": [1.0]}, "motion: shift_u: found .*nan.* finite"),
        ({"shift_u": [1.0], "shift_v": [[1.0]]}, r"shift_v: found shape \(1, 1\)"),
        ({"shift_u": [1.0], "shift_v": [1.0], "magnification": [0.0]}, "magnification"),
        ({"shift_u": [1.0], "shift_v": [1.0], "flagged": [1]}, r"flagged: found \[1.0\], expected"),
    ],
)
def test_damaged_files(tmp_path: Path, columns: dict[str, list[float]], message: str) -> None:
    path = tmp_path / "motion.h5"
    with h5py.File(path, "w") as file:
        for name, values in columns.items():
            file[f"motion/{name}"] = values
    with pytest.raises(InputError, match=message) as caught:
        read_motion_file(path)
    assert str(path) in str(caught.value)


def test_a_file_without_a_list_flags_what_has_no_confidence(tmp_path: Path) -> None:
    path = tmp_path / "motion.h5"
    with h5py.File(path, "w") as file:
        for name, values in {"shift_u": [1, 2, 3], "shift_v": [3, 4, 5]}.items():
            file[f"motion/{name}"] = values
        file["motion/confidence"] = [0.9, 0.0, 0.8]
    assert read_motion_file(path).flagged == (1,)


def test_confidence_of_another_length(tmp_path: Path, motion: Motion) -> None:
    with pytest.raises(ValueError, match=r"confidence: found shape \(3,\), expected \(9,\)"):
        write_motion_file(tmp_path / "motion.h5", motion, confidence=np.ones(3))
    assert not list(tmp_path.iterdir())


def test_a_motion_saves_and_loads_itself(tmp_path: Path, motion: Motion) -> None:
    motion.save(tmp_path / "motion.h5")
    assert Motion.load(tmp_path / "motion.h5") == motion
