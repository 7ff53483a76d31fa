"""Values of an alignment as plain values and arrays, for checkpoints."""

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clra.methods.alignment.prealignment.prealignment import Prealignment
from clra.methods.alignment.reprojection import Registered
from clra.methods.alignment.result import Iteration
from clra.model.motion import Motion
from clra.model.rigid.rigid_motion import RigidMotion

Arrays = Mapping[str, NDArray[Any]]
State = tuple[dict[str, Any], dict[str, NDArray[Any]]]
"""Plain values and arrays, as :meth:`clra.methods.execution.checkpoint.Checkpoint.save` keeps."""


def motion_arrays(name: str, motion: Motion) -> dict[str, NDArray[Any]]:
    """Return a motion as one array (numbers, views), its cause apart."""
    return {name: np.stack(motion.columns())}


def motion_from(arrays: Arrays, name: str, cause: str) -> Motion:
    """Return the motion that :func:`motion_arrays` packed."""
    if cause == "sample":
        table = arrays[name].T
        return RigidMotion(translation=table[:, :3], rotation=table[:, 3:6], optics=table[:, 6:])
    u, v, magnification = arrays[name]
    return Motion(shift_u=u, shift_v=v, magnification=magnification, cause=cause)


def registered_arrays(found: Registered | None) -> dict[str, NDArray[Any]]:
    """Return the columns of a registration, if there is one."""
    if found is None:
        return {}
    columns = {f"registered_{n}": getattr(found, n) for n in ("correlation", "residual", "sigma")}
    return motion_arrays("registered", found.motion) | columns


def registered_from(arrays: Arrays) -> Registered | None:
    """Return the registration that :func:`registered_arrays` packed."""
    if "registered" not in arrays:
        return None
    columns = {n: arrays[f"registered_{n}"] for n in ("correlation", "residual", "sigma")}
    return Registered(motion_from(arrays, "registered", "detector"), **columns)


def history_values(history: tuple[Iteration, ...] | list[Iteration]) -> list[dict[str, Any]]:
    """Return the iterations as plain values."""
    return [asdict(iteration) for iteration in history]


def history_from(values: list[dict[str, Any]]) -> list[Iteration]:
    """Return the iterations that :func:`history_values` packed."""
    return [Iteration(**value) for value in values]


def prealigned_arrays(found: Prealignment | None) -> dict[str, NDArray[Any]]:
    """Return a pre-alignment, if there is one."""
    if found is None:
        return {}
    quality = np.array([found.correlation, found.residual])
    arrays = {"prealigned_known": found.known, "prealigned_exact": found.exact}
    arrays |= {"prealigned_quality": quality}
    return motion_arrays("prealigned", found.motion) | arrays


def prealigned_from(arrays: Arrays) -> Prealignment | None:
    """Return the pre-alignment that :func:`prealigned_arrays` packed."""
    if "prealigned" not in arrays:
        return None
    correlation, residual = arrays["prealigned_quality"].tolist()
    motion = motion_from(arrays, "prealigned", "detector")
    known, exact = arrays["prealigned_known"], arrays["prealigned_exact"]
    return Prealignment(motion, known, exact, correlation, residual)
