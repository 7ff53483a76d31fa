"""A small NXtomo file written field by field, which tests then damage."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

VIEWS, ROWS, COLUMNS = 7, 5, 6
# Order of the frames: two darks, two flats, the radiographs, two flats.
ROLES = np.array([2, 2, 1, 1, *[0] * VIEWS, 1, 1])
DARK, EARLY_FLAT, LATE_FLAT = 100, 1100, 2100


def transmission() -> np.ndarray:
    """What the radiographs are to become, exact in float32."""
    ramp = np.arange(VIEWS * ROWS * COLUMNS).reshape(VIEWS, ROWS, COLUMNS)
    return 0.25 + ramp / (2.0 * ramp.size)


def counts() -> np.ndarray:
    """Frames as float64: flats grow from the first group (frame 2.5) to the last (frame 11.5)."""
    frames = np.empty((len(ROLES), ROWS, COLUMNS))
    frames[ROLES == 2] = DARK
    position = np.flatnonzero(ROLES == 0)
    flat = EARLY_FLAT + (LATE_FLAT - EARLY_FLAT) * (position - 2.5) / 9.0
    frames[ROLES == 0] = DARK + transmission() * (flat - DARK)[:, None, None]
    frames[2:4], frames[-2:] = EARLY_FLAT, LATE_FLAT
    return frames


def put(group: h5py.Group, name: str, value: Any, units: str | None = None) -> None:
    """Replace a data set."""
    if name in group:
        del group[name]
    group[name] = value
    if units is not None:
        group[name].attrs["units"] = units


Builder = Callable[..., Path]


@pytest.fixture
def nxtomo_file(tmp_path: Path) -> Builder:
    def build(
        edit: Callable[[h5py.Group], None] | None = None,
        *,
        frames: np.ndarray | None = None,
        name: str = "scan.nxs",
    ) -> Path:
        path = tmp_path / name
        with h5py.File(path, "w") as file:
            entry = file.create_group("entry")
            entry.attrs["NX_class"] = "NXentry"
            entry["definition"] = "NXtomo"
            put(entry, "instrument/detector/data", counts() if frames is None else frames)
            put(entry, "instrument/detector/image_key", ROLES)
            put(entry, "instrument/detector/x_pixel_size", 50.0, "um")
            put(entry, "instrument/detector/y_pixel_size", 0.06, "mm")
            put(entry, "instrument/detector/distance", 0.3, "m")
            put(entry, "instrument/source/distance", -200.0, "mm")
            put(entry, "sample/rotation_angle", 10.0 * np.arange(len(ROLES)), "degree")
            if edit is not None:
                edit(entry)
        return path

    return build
