import json
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

import clra
from clra.errors import InputError
from clra.findings import Finding
from clra.methods.alignment.result import AlignmentResult, Iteration
from clra.model.motion import Motion

VIEWS = 9
HISTORY = (
    Iteration("QR", 1, 1.5, 1.4, 3.9, 0.8, 0.05, 2.0, note="few features\n3 < 4 views"),
    Iteration("HR", 1, 0.2, 0.1, 0.4, 0.9, 0.04, 8.0, 0.1, 0.1, 1e-4, 0.05, 0.05, 1e-4, misfit=2.0),
)


@dataclass(frozen=True)
class Verdict:
    verdict: str

    def as_dict(self) -> dict[str, Any]:
        return asdict(self)


@pytest.fixture
def result() -> AlignmentResult:
    rng = np.random.default_rng(0)
    sigma = rng.uniform(0.01, 0.02, (VIEWS, 3))
    sigma[2] = np.nan  # a view that was not registered
    return AlignmentResult(
        motion=Motion(
            shift_u=rng.normal(size=VIEWS),
            shift_v=rng.normal(size=VIEWS),
            magnification=rng.uniform(0.99, 1.01, VIEWS),
            cause="source",
        ),
        valid_views=np.arange(VIEWS) % 4 != 2,
        confidence=rng.uniform(0.5, 1, VIEWS),
        sigma=sigma,
        history=HISTORY,
        gauge={"translation x": 0.25, "tilt y": 0.125},
        warnings=(Finding("lost", "few features", "start finer", measured={"correlation": 0.5}),),
        volume=rng.random((3, 4, 5)).astype(np.float32),
        method="ra",
        schedule="1QR-1HR",
        estimate="source",
        device="a device",
        command="clra align scan.nxs -o motion.h5",
        versions={"clra": "0.2.0", "pyopencl": "2025.1", "driver": "a driver 1"},
        scan="scan.nxs",
        checksum="sha256:0",
        about={"unobservable": "taken out"},
    )


def test_everything_survives(tmp_path: Path, result: AlignmentResult) -> None:
    path = tmp_path / "motion.h5"
    clra.write_alignment(path, result)
    assert clra.read_alignment(path) == result
    assert [file.name for file in tmp_path.iterdir()] == ["motion.h5"]
    for different in (
        replace(result, sigma=2 * result.sigma),
        replace(result, valid_views=~result.valid_views),
        replace(result, volume=None),
        replace(result, warnings=()),
        replace(result, motion=result.motion.caused_by("detector")),
    ):
        clra.write_alignment(path, different)
        assert clra.read_alignment(path) == different != result


def test_the_quality_survives_as_plain_values(tmp_path: Path, result: AlignmentResult) -> None:
    path = tmp_path / "motion.h5"
    clra.write_alignment(path, replace(result, quality=Verdict("good")))
    with h5py.File(path) as file:
        assert json.loads(file["quality"].asstr()[()]) == {"verdict": "good"}


def test_others_read_the_file(tmp_path: Path, result: AlignmentResult) -> None:
    clra.write_alignment(tmp_path / "motion.h5", result)
    with h5py.File(tmp_path / "motion.h5") as file:
        np.testing.assert_array_equal(file["motion/shift_u"], result.motion.shift_u)
        assert file["motion/shift_u"].attrs["units"] == "pixel"
        assert file["motion/magnification"].attrs["units"] == "1"
        assert file["motion/flagged"][()].tolist() == [2, 6]
        assert list(file["history/level"].asstr()) == ["QR", "HR"]
        assert file.attrs["schedule"] == "1QR-1HR" and file.attrs["version"] == "0.2.0"


def test_files_of_version_0_1_0_are_read(tmp_path: Path) -> None:
    path = tmp_path / "motion.h5"
    with h5py.File(path, "w") as file:  # as that version wrote them
        file.attrs.update(version="0.1.0", schedule="1QR", device="a device", scan="scan.nxs")
        file.attrs.update(checksum="sha256:0", gauge='{"tilt x": 0.5}', estimate="shift+scale")
        file.attrs.update(sigma_u=0.01, sigma_v=0.02, sigma_magnification=1e-4, command="clra")
        file.attrs.update(unobservable="taken out", geometry="--rotation cw")
        group = file.create_group("motion")
        group.attrs["cause"] = "panel"
        group["shift_u"], group["shift_v"] = [1.0, 2, 3], [3.0, 4, 5]
        group["magnification"] = [1.0, 1.001, 0.999]
        group["confidence"] = [0.9, 0.0, 0.8]
        group["flagged"] = [1]
        for name, value in asdict(HISTORY[0]).items():
            texts = isinstance(value, str)
            data = [value] if texts else [np.nan if value is None else value]
            group.file[f"history/{name}"] = np.array(
                data, dtype=h5py.string_dtype() if texts else None
            )
    read = clra.read_alignment(path)
    assert read.motion == Motion(
        shift_u=[1, 2, 3], shift_v=[3, 4, 5], magnification=[1, 1.001, 0.999]
    )
    assert read.flagged == (1,) and read.confidence.tolist() == [0.9, 0, 0.8]
    assert read.history == HISTORY[:1]
    assert read.gauge == {"tilt x": 0.5} and read.median_sigma == (0.01, 0.02, 1e-4)
    assert [str(finding) for finding in read.warnings] == ["few features", "3 < 4 views"]
    assert read.versions == {"clra": "0.1.0"} and read.schedule == "1QR" and read.command == "clra"
    assert read.about == {"unobservable": "taken out", "geometry": "--rotation cw"}
    clra.write_alignment(path, read)
    assert clra.read_alignment(path) == read


def test_only_shifts_are_needed(tmp_path: Path) -> None:
    path = tmp_path / "motion.h5"
    with h5py.File(path, "w") as file:
        file["motion/shift_u"] = [1, 2]
        file["motion/shift_v"] = [3.0, 4.0]
    assert clra.read_alignment(path) == AlignmentResult.from_motion(
        Motion(shift_u=[1, 2], shift_v=[3, 4])
    )


def test_a_file_without_a_list_rejects_what_has_no_confidence(tmp_path: Path) -> None:
    path = tmp_path / "motion.h5"
    with h5py.File(path, "w") as file:
        for name, values in {"shift_u": [1, 2, 3], "shift_v": [3, 4, 5]}.items():
            file[f"motion/{name}"] = values
        file["motion/confidence"] = [0.9, 0.0, 0.8]
    assert clra.read_alignment(path).flagged == (1,)


def test_a_history_without_what_may_be_missing_is_read(
    tmp_path: Path, result: AlignmentResult
) -> None:
    path = tmp_path / "motion.h5"
    clra.write_alignment(path, result)
    with h5py.File(path, "a") as file:
        del file["history/note"], file["history/misfit"]
    bare = tuple(replace(step, note="", misfit=None) for step in HISTORY)
    assert clra.read_alignment(path).history == bare
    with h5py.File(path, "a") as file:
        del file["history/residual"]
    assert clra.read_alignment(path).history == ()


@pytest.mark.parametrize(
    ("columns", "message"),
    [
        ({"shift_u": [1.0]}, "motion/shift_v: found nothing, expected a motion"),
        ({"shift_u": [1.0, 2], "shift_v": [1.0]}, "shift_v: found 1 values, expected 2"),
        ({"shift_u": [np.nan], "shift_v": [1.0]}, "motion: shift_u: found .*nan.* finite"),
        ({"shift_u": [1.0], "shift_v": [[1.0]]}, r"shift_v: found shape \(1, 1\)"),
        ({"shift_u": [1.0], "shift_v": [1.0], "magnification": [0.0]}, "magnification"),
        ({"shift_u": [1.0], "shift_v": [1.0], "flagged": [1]}, r"flagged: found \[1.0\], expected"),
        ({"shift_u": [1.0], "shift_v": [1.0], "sigma": [1.0]}, r"sigma: found shape \(1,\)"),
    ],
)
def test_damaged_files(tmp_path: Path, columns: dict[str, list[float]], message: str) -> None:
    path = tmp_path / "motion.h5"
    with h5py.File(path, "w") as file:
        for name, values in columns.items():
            file[f"motion/{name}"] = values
    with pytest.raises(InputError, match=message) as caught:
        clra.read_alignment(path)
    assert str(path) in str(caught.value)


@pytest.mark.parametrize(
    ("name", "value"), [("warnings", "[{]"), ("warnings", '[{"colour": 1}]'), ("versions", "{")]
)
def test_damaged_json(tmp_path: Path, result: AlignmentResult, name: str, value: str) -> None:
    path = tmp_path / "motion.h5"
    clra.write_alignment(path, result)
    with h5py.File(path, "a") as file:
        del file[name]
        file[name] = value
    with pytest.raises(InputError, match=f"motion.h5: /{name}"):
        clra.read_alignment(path)


def test_an_unknown_cause(tmp_path: Path, result: AlignmentResult) -> None:
    path = tmp_path / "motion.h5"
    clra.write_alignment(path, result)
    with h5py.File(path, "r+") as file:
        file["motion"].attrs["cause"] = "stage"
    with pytest.raises(InputError, match="/motion: cause: found 'stage', expected one of"):
        clra.read_alignment(path)
