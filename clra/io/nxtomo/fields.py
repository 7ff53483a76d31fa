"""The geometry as NXtomo's own fields tell it, and what the user may say against them."""

from __future__ import annotations

from dataclasses import dataclass

import h5py
import numpy as np
from numpy.typing import NDArray

from clra.errors import InputError
from clra.findings import warn
from clra.io.hdf5 import angles, find, lengths, require
from clra.io.nxtomo.geometry_fields import Fields, far_source_distance

Floats = NDArray[np.float64]

# Pixels larger than this are in other units than the file says, or says by default [mm].
_LARGEST = 20.0


@dataclass(frozen=True)
class Overrides:
    """What the user says about the geometry against, or in place of, the file.

    Parameters
    ----------
    rotation : {"ccw", "cw"}
        How the sample turns as its angle grows, seen from above.
    source_distance : float, optional
        From source to axis [mm]; infinite for a parallel beam.
    parallel : bool
        The beam is parallel.
    """

    rotation: str = "ccw"
    source_distance: float | None = None
    parallel: bool = False

    def __post_init__(self) -> None:
        if self.rotation not in ("ccw", "cw"):
            raise InputError.at("--rotation", "rotation", repr(self.rotation), "ccw or cw")
        if self.source_distance is not None and not abs(self.source_distance) > 0:
            found = self.source_distance
            raise InputError.at("--source-distance", "source_distance", found, "above 0 mm")

    @property
    def any(self) -> bool:
        """Whether anything is said at all."""
        return self != Overrides()


def read_fields(
    entry: h5py.Group,
    detector: h5py.Group,
    count: int,
    views: NDArray[np.intp],
    shape: tuple[int, int],
    overrides: Overrides,
) -> Fields:
    """Read the geometry from NXtomo's own fields.

    Parameters
    ----------
    entry, detector : h5py.Group
        The scan and its detector.
    count : int
        Frames of every role.
    views : ndarray of int
        Which of them are radiographs.
    shape : (int, int)
        Rows and columns of the detector.
    overrides : Overrides
        What the user says.

    Raises
    ------
    InputError
        If a field is missing, of the wrong length, or impossible.
    """
    _warn_of_unused(detector)
    width, height = (
        _positive(require(detector, name, "the size of a pixel"))
        for name in ("x_pixel_size", "y_pixel_size")
    )
    far = far_source_distance(shape, width)
    source = _source_distance(entry, overrides)
    parallel = overrides.parallel or bool(np.isinf(source).any())
    source = np.full(1, far) if parallel else source
    distance = find(detector, "distance")
    if parallel:
        behind = np.zeros(1)
    else:
        distance = require(detector, "distance", "the distance from sample to detector")
        behind = np.abs(lengths(distance, "the distance from sample to detector"))
        # A detector at the axis is how we write a parallel beam, and then the source is far away.
        if not behind.all() and not np.allclose(source, far, rtol=1e-9):
            raise InputError.at(distance.file.filename, distance.name, "0 mm", "above 0 mm")
    turn = find(entry, "sample/rotation_angle") or find(entry, "data/rotation_angle")
    if not isinstance(turn, h5py.Dataset):
        turn = require(entry, "sample/rotation_angle", "the angle of each frame")
    angle = angles(turn, "the angle of each frame", finite=False)
    if len(angle) != count:
        raise InputError.at(
            turn.file.filename, turn.name, f"{len(angle)} angles", f"{count}, one a frame"
        )
    angle = _at_views(angle, count, views, turn.file.filename, turn.name)
    translation = [_translation(entry, name, count, views) for name in "xyz"]
    file, where = entry.file.filename, f"{entry.name}/instrument"
    return Fields(
        angle=angle if overrides.rotation == "ccw" else -angle,
        translation=np.stack(translation, axis=1),
        source_distance=_at_views(source, count, views, file, f"{where}/source/distance"),
        detector_distance=_at_views(behind, count, views, file, f"{where}/detector/distance"),
        pixel=(width, height),
    )


def _source_distance(entry: h5py.Group, overrides: Overrides) -> Floats:
    """Distance from source to axis, positive [mm]."""
    if overrides.parallel:
        return np.full(1, np.inf)
    if overrides.source_distance is not None:
        return np.full(1, abs(float(overrides.source_distance)))
    where = "instrument/source/distance"
    distance = find(entry, where)
    values = np.zeros(1)
    if isinstance(distance, h5py.Dataset):
        values = np.abs(lengths(distance, "the distance from source to sample", finite=False))
    if not values.all():
        found = "0 mm" if isinstance(distance, h5py.Dataset) else "nothing"
        raise InputError.at(
            entry.file.filename, f"{entry.name}/{where}", found,
            "the distance from source to sample: give --source-distance MM, or --parallel",
        )  # fmt: skip
    return values


def _translation(entry: h5py.Group, axis: str, count: int, views: NDArray[np.intp]) -> Floats:
    """Read the translation of the sample in each view [mm]; 0 where the file tells none."""
    found = find(entry, f"sample/{axis}_translation")
    if not isinstance(found, h5py.Dataset):
        return np.zeros(len(views))
    values = lengths(found, "the translation of each frame", finite=False)
    return _at_views(values, count, views, found.file.filename, found.name)


def _at_views(values: Floats, count: int, views: NDArray[np.intp], file: str, field: str) -> Floats:
    """Pick the values of the radiographs, of one for all frames or one each."""
    if len(values) not in (1, count):
        raise InputError.at(file, field, f"{len(values)} values", f"1 or {count}")
    picked = np.broadcast_to(values, count)[views]
    bad = ~np.isfinite(picked)
    if bad.any():
        found = f"{picked[bad][0]} at frame {views[bad][0]}"
        raise InputError.at(file, field, found, "finite numbers")
    return picked


def _positive(dataset: h5py.Dataset) -> float:
    value = float(lengths(dataset, "the size of a pixel")[0])
    if value <= 0:
        raise InputError.at(dataset.file.filename, dataset.name, f"{value:g} mm", "above 0 mm")
    if value > _LARGEST:
        name = f"{dataset.file.filename}: {dataset.name}"
        warn("units", f"{name}: {value:g} mm: are the units right, or missing?")
    return value


def _warn_of_unused(detector: h5py.Group) -> None:
    """Warn of what files tell in different senses, so that none can be taken."""
    told = [
        name
        for name in ("x_rotation_axis_pixel_position", "x_flipped", "y_flipped")
        if isinstance(detector.get(name), h5py.Dataset) and np.any(detector[name][()])
    ]
    turns = detector.get("transformations")
    if isinstance(turns, h5py.Group):
        told += [
            f"transformations/{name}"
            for name in ("rx", "ry", "rz")
            if isinstance(turns.get(name), h5py.Dataset) and np.any(turns[name][()])
        ]
    if told:
        warn(
            "units",
            f"{detector.file.filename}: {detector.name}: {', '.join(told)} not used: row 0 is "
            "taken as the top, columns as counted to the right seen from the source, and the axis "
            "where x_translation puts it",
        )
