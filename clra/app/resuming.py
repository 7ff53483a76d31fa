"""What an interrupted multigrid reconstruction leaves behind, and how it goes on."""

import hashlib
import json
import os
import shutil
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clra.errors import InputError, OutputError
from clra.io.alignment_file import read_alignment, write_alignment
from clra.io.volumes.volume_files import open_volume, read_volume
from clra.methods.alignment.reprojection import with_margin
from clra.methods.alignment.result import AlignmentResult
from clra.methods.reconstruction.imgr_state import ImgrState, ImgrStep
from clra.model.grid import VolumeGrid
from clra.model.scan import Scan
from clra.model.schedule import level_factor
from clra.ops.streaming.slab_projector import volume_from
from clra.ops.streaming.stream import Stream


class SavedState:
    """The folder beside a volume that holds what the finished levels gave.

    volume.h5 is the volume at the resolution of the last level, with its margin; motion.h5 the
    motion, the history and the settings of the run.

    Parameters
    ----------
    out : path-like
        Volume that is to be written.
    scan : Scan
        That is reconstructed.
    settings : mapping
        What has to be the same for the run to go on, as JSON takes it.

    Attributes
    ----------
    folder : Path
        Where it is.
    """

    def __init__(self, out: str | os.PathLike[str], scan: Scan, settings: dict[str, Any]) -> None:
        self.folder = Path(out).with_name(f"{Path(out).name}.resume")
        self._scan = scan
        masks = [] if scan.mask is None else [scan.mask]
        geometry = fingerprint(scan.geometry.to_astra(), *masks)
        self._settings = json.dumps(settings | {"geometry": geometry}, sort_keys=True)

    def save(self, state: ImgrState) -> None:
        """Keep what the finished levels gave.

        Raises
        ------
        OutputError
            If it cannot be written.
        """
        assert state.volume is not None
        self.clear()
        try:
            self.folder.mkdir()
        except OSError as error:
            raise OutputError(f"cannot make the folder {self.folder}: {error.strerror}") from error
        with open_volume(self.folder / "volume.h5", state.volume.grid) as target:
            state.volume.write(target)
        # Last, so that it stands for the whole.
        kept = replace(
            AlignmentResult.from_motion(state.motion, ~state.rejected),
            history=state.history,
            scan=self._scan.name,
            checksum=self._scan.checksum(),
            about={
                "settings": self._settings,
                "steps": json.dumps([asdict(step) for step in state.steps]),
                "ended": "yes" if state.ended else "no",
            },
        )
        write_alignment(self.folder / "motion.h5", kept)

    def load(self, stream: Stream, grid: VolumeGrid) -> ImgrState:
        """Take up what the finished levels gave.

        Parameters
        ----------
        stream : Stream
            Where the volume goes.
        grid : VolumeGrid
            Of the volume that is to be written.

        Raises
        ------
        InputError
            If there is nothing, or it belongs to another scan or to other settings.
        """
        path = self.folder / "motion.h5"
        if not path.is_file():
            raise InputError(f"{path}: not found, expected what an interrupted run leaves there")
        file = read_alignment(path)
        if file.checksum != self._scan.checksum():
            raise InputError.at(path, "/@checksum", "another scan", self._scan.name)
        if file.about.get("settings") != self._settings:
            found = file.about.get("settings", "none")
            raise InputError.at(path, "/@settings", found, self._settings)
        steps = tuple(ImgrStep(**step) for step in json.loads(file.about["steps"]))
        level = level_factor(steps[-1].level)
        wide = with_margin(grid)
        wide = wide.binned(level) if level > 1 else wide
        volume = volume_from(stream, wide, _Planes(self.folder / "volume.h5", wide))
        return ImgrState(
            volume,
            file.motion,
            ~file.valid_views,
            steps,
            file.history,
            file.about.get("ended") == "yes",
        )

    def clear(self) -> None:
        """Remove it, if there is any."""
        shutil.rmtree(self.folder, ignore_errors=True)


def fingerprint(*arrays: NDArray[Any]) -> str:
    """Return a short text that is the same for the same numbers."""
    digest = hashlib.sha256()
    for array in arrays:
        digest.update(
            f"{array.shape}{array.dtype}".encode() + np.ascontiguousarray(array).tobytes()
        )
    return digest.hexdigest()[:16]


class _Planes:
    """A volume in a file, read when planes of it are asked for."""

    def __init__(self, path: Path, grid: VolumeGrid) -> None:
        self.shape = grid.shape
        self._path = path

    def __getitem__(self, planes: slice) -> NDArray[np.float32]:
        return read_volume(self._path, planes.start, planes.stop)[0]
