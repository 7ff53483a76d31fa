"""Finished work of a long call, kept on disk so that no interruption loses it."""

from __future__ import annotations

import hashlib
import json
import logging
import os
import shutil
import zlib
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any
from zipfile import BadZipFile

import numpy as np
from numpy.typing import NDArray

from clra.errors import InputError
from clra.findings import Finding, collected_so_far
from clra.model.grid import VolumeGrid
from clra.model.motion import Motion
from clra.model.scan import Scan
from clra.ops.streaming.volume import PlaneSource

_LOG = logging.getLogger(__name__)
_STATE = "state.json"
_DAMAGED = (OSError, ValueError, KeyError, TypeError)


@dataclass(frozen=True)
class Saved:
    """What a checkpoint holds.

    Attributes
    ----------
    kept : str
        What is finished, for people: "2 iterations, the last at QR".
    values : dict
        Plain values.
    arrays : dict of str to ndarray
        Small arrays.
    planes : ndarray of float32, (nz, ny, nx), or None
        A volume; mapped, not read.
    """

    kept: str
    values: dict[str, Any]
    arrays: dict[str, NDArray[Any]]
    planes: NDArray[np.float32] | None


class Checkpoint:
    """A folder that holds the last finished state of a call.

    A state appears whole or not at all: state.json, which names the files of the state, is replaced
    last. Where the disk does not take a state, the one before stays and the call goes on.

    Parameters
    ----------
    path : path-like
        The folder; made when the first state is kept.
    resume : bool
        Whether to go on from what it holds, which must be there; by default that is replaced.
    """

    def __init__(self, path: str | os.PathLike[str], *, resume: bool = False) -> None:
        self.folder = Path(path)
        self.resume = resume
        self._identity: dict[str, Any] = {}
        self._number = 0
        self._kept = ""
        self._parts: list[Checkpoint] = []

    @property
    def kept(self) -> str:
        """What it holds of this call, for people; "" if nothing."""
        return self._kept or next((part.kept for part in self._parts if part.kept), "")

    @property
    def there(self) -> bool:
        """Whether the folder holds a state, of this call or of another."""
        return (self.folder / _STATE).is_file()

    def part(self, name: str) -> Checkpoint:
        """Return a checkpoint within this one, to be resumed if it holds something."""
        part = Checkpoint(self.folder / name)
        part.resume = self.resume and part.there
        self._parts.append(part)
        return part

    def begin(self, identity: Mapping[str, Any]) -> Saved | None:
        """Return the state to go on from, if that was asked for.

        Parameters
        ----------
        identity : mapping
            Plain values by name that have to be the same for a call to go on: of scan and options.

        Raises
        ------
        InputError
            If there is no state, or one of another scan or of other options.
        """
        self._identity = json.loads(json.dumps(dict(identity)))
        self._kept = ""
        if self.resume:
            return self._load()
        with suppress(InputError):
            left = self._state()
            self._number = int(left["number"])
            message = f"{self.folder} keeps {left['kept']} of an earlier run"
            Finding("checkpoint", message, "they are replaced, as it is not resumed").warn()
        return None

    def save(
        self,
        kept: str,
        values: Mapping[str, Any],
        arrays: Mapping[str, NDArray[Any]],
        volume: PlaneSource | None = None,
    ) -> None:
        """Keep a state in place of the one before; see :class:`Saved` for the parameters."""
        number = self._number + 1
        state = {
            "number": number,
            "kept": kept,
            "identity": self._identity,
            "values": dict(values),
            "findings": [finding.as_dict() for finding in collected_so_far()],
            "volume": volume is not None,
        }
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            self._write(f"{number}.npz", lambda file: np.savez(file, **arrays))  # type: ignore[arg-type]
            if volume is not None:
                self._write(f"{number}.npy", lambda file: volume.write(_Planes(file, volume)))
            self._write(_STATE, lambda file: file.write(json.dumps(state).encode()))
        except OSError as error:
            self._clean(self._number)
            message = f"{self.folder}: cannot keep {kept}: {error.strerror or error}"
            advice = "an interruption from here on loses what is not kept" + (
                f", but for {self._kept}" if self._kept else ""
            )
            Finding("checkpoint", message, advice).warn()
            return
        self._number, self._kept = number, kept
        self._clean(number)
        _LOG.debug("%s keeps %s", self.folder, kept)

    def clear(self) -> None:
        """Remove it, if there is any."""
        shutil.rmtree(self.folder, ignore_errors=True)
        self._kept = ""

    def _write(self, name: str, fill: Callable[[IO[bytes]], object]) -> None:
        """Write a file that appears whole."""
        part = self.folder / f"{name}.part"
        with open(part, "wb") as file:
            fill(file)
            file.flush()
            os.fsync(file.fileno())
        os.replace(part, self.folder / name)

    def _clean(self, number: int) -> None:
        """Remove what belongs to no state, or to another."""
        with suppress(OSError):
            for path in self.folder.iterdir():
                if path.is_file() and path.name not in (
                    _STATE,
                    f"{number}.npz",
                    f"{number}.npy",
                ):
                    path.unlink()

    def _state(self) -> dict[str, Any]:
        """Read state.json."""
        path = self.folder / _STATE
        if not path.is_file():
            raise InputError(f"{path}: not found, expected what an interrupted run leaves there")
        try:
            state = json.loads(path.read_bytes())
            return {**state, "number": int(state["number"]), "kept": str(state["kept"])}
        except _DAMAGED as error:
            raise InputError(f"{path}: no state that clra kept: {error}") from error

    def _load(self) -> Saved:
        """Read the whole state."""
        path, state = self.folder / _STATE, self._state()
        try:
            number, identity = state["number"], state["identity"]
            with open(self.folder / f"{number}.npz", "rb") as raw, np.load(raw) as file:
                arrays = dict(file)
            planes = None
            if state["volume"]:
                planes = np.load(self.folder / f"{number}.npy", mmap_mode="r")
            saved = Saved(state["kept"], dict(state["values"]), arrays, planes)
            findings = [Finding.from_dict(values) for values in state["findings"]]
        except (*_DAMAGED, BadZipFile, EOFError, zlib.error) as error:
            raise InputError(f"{path}: no state that clra kept: {error}") from error
        for name, expected in self._identity.items():
            if identity.get(name) != expected:
                raise InputError.at(path, name, repr(identity.get(name)), f"{expected!r} as now")
        self._number, self._kept = number, saved.kept
        for finding in findings:
            finding.warn()
        return saved


def checkpoint_of(
    checkpoint: str | os.PathLike[str] | Checkpoint | None, resume: bool
) -> tuple[Checkpoint | None, bool]:
    """Return the checkpoint that is meant, and whether to remove it at success.

    Raises
    ------
    InputError
        If there is none to resume from.
    """
    if isinstance(checkpoint, Checkpoint):
        return checkpoint, False
    if checkpoint is None:
        if resume:
            raise InputError("resume: found no checkpoint, expected the folder to go on from")
        return None, False
    return Checkpoint(checkpoint, resume=resume), True


def cancelled(findings: Iterable[Finding]) -> bool:
    """Tell whether a call was ended early."""
    return any(finding.code == "cancelled" for finding in findings)


def identity(
    scan: Scan,
    grid: VolumeGrid,
    options: Mapping[str, Any],
    *,
    motion: Motion | None = None,
    valid_views: NDArray[np.bool_] | None = None,
) -> dict[str, Any]:
    """Return by what a state is known to belong to a call; see :meth:`Checkpoint.begin`."""
    masks = [] if scan.mask is None else [scan.mask]
    corrected = None
    if scan.corrections is not None:
        arrays = (scan.corrections.bad, scan.corrections.rings)
        known = fingerprint(*(array for array in arrays if array is not None))
        corrected = f"{scan.corrections.contents()} {known}"
    moved = None
    if motion is not None:
        moved = f"{motion.cause} {fingerprint(*motion.columns())}"
    return {
        "scan": scan.checksum(),
        "geometry": fingerprint(scan.geometry.to_astra(), *masks),
        "grid": [*grid.shape, grid.voxel_size, *grid.centre],
        "corrections": corrected,
        "motion": moved,
        "valid_views": None if valid_views is None else fingerprint(valid_views),
        **{name: _plain(value) for name, value in options.items()},
    }


def _plain(value: Any) -> Any:
    """Return an option as it is compared."""
    if isinstance(value, np.ndarray):
        return fingerprint(value)
    return value if isinstance(value, (str, int, float, bool, type(None))) else repr(value)


def fingerprint(*arrays: NDArray[Any]) -> str:
    """Return a short text that is the same for the same numbers."""
    digest = hashlib.sha256()
    for array in arrays:
        digest.update(
            f"{array.shape}{array.dtype}".encode() + np.ascontiguousarray(array).tobytes()
        )
    return digest.hexdigest()[:16]


class _Planes:
    """Takes the planes of a volume into a .npy file."""

    def __init__(self, file: IO[bytes], volume: PlaneSource) -> None:
        shape = volume.grid.shape
        header = {"descr": "<f4", "fortran_order": False, "shape": shape}
        np.lib.format.write_array_header_1_0(file, header)
        self._file, self._start, self._stride = file, file.tell(), 4 * shape[1] * shape[2]

    def write(self, start: int, part: NDArray[np.float32]) -> None:
        """Take planes (n, y, x) from plane `start` on."""
        self._file.seek(self._start + start * self._stride)
        self._file.write(np.ascontiguousarray(part, "<f4").tobytes())
