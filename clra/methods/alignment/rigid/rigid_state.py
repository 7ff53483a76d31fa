"""What the iterations of a rigid alignment hand on, and how a checkpoint keeps it."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clra.methods.alignment.result import Iteration
from clra.methods.alignment.rigid.rigid_solution import RigidStep
from clra.methods.alignment.rigid.slow_extrapolation import SlowExtrapolation
from clra.methods.execution.checkpoint import Saved
from clra.methods.execution.packing import (
    State,
    history_from,
    history_values,
    motion_arrays,
    motion_from,
)
from clra.model.rigid.rigid_motion import RigidMotion

Floats = NDArray[np.float64]

_NAME = "rigid"
_STEP = ("table", "sigma", "alone", "correlation", "residual")


@dataclass
class RigidState:
    """A rigid alignment after some of its iterations.

    Attributes
    ----------
    motion : RigidMotion
        As found so far.
    rejected : ndarray of bool, (views,)
        Views that are not used.
    history : list of Iteration
        Those of the shifts included.
    position : (int, int)
        Stage, and how many of its iterations are done.
    last : RigidStep or None
        What the last iteration found.
    bias : ndarray, (views, 6), or None
        Of the stage's resolution, once it is known.
    slow : SlowExtrapolation
        Of the stage.
    """

    motion: RigidMotion
    rejected: NDArray[np.bool_]
    history: list[Iteration]
    position: tuple[int, int] = (0, 0)
    last: RigidStep | None = None
    bias: Floats | None = None
    slow: SlowExtrapolation = field(default_factory=SlowExtrapolation)

    def packed(self, shifts: State) -> State:
        """Return it as a checkpoint keeps it, beside the state of the shifts it began with."""
        values, arrays = dict(shifts[0]), dict(shifts[1])
        values[_NAME] = {"position": self.position, "history": history_values(self.history)}
        mine = motion_arrays("motion", self.motion) | {"rejected": self.rejected}
        if self.last is not None:
            mine |= {name: getattr(self.last, name) for name in _STEP}
        more = {
            "bias": self.bias,
            "slow": self.slow.last,
            "contraction": self.slow.contraction,
        }
        mine |= {name: array for name, array in more.items() if array is not None}
        return values, arrays | {f"{_NAME}_{name}": array for name, array in mine.items()}

    @classmethod
    def kept(cls, saved: Saved) -> "RigidState | None":
        """Return what :meth:`packed` gave, if a checkpoint holds it."""
        values: Mapping[str, Any] | None = saved.values.get(_NAME)
        if values is None:
            return None
        start = len(_NAME) + 1
        arrays = {n[start:]: a for n, a in saved.arrays.items() if n.startswith(f"{_NAME}_")}
        motion = motion_from(arrays, "motion", "sample")
        assert isinstance(motion, RigidMotion)
        stage, done = values["position"]
        return cls(
            motion=motion,
            rejected=arrays["rejected"].astype(np.bool_),
            history=history_from(values["history"]),
            position=(stage, done),
            last=RigidStep(**{name: arrays[name] for name in _STEP}),
            bias=arrays.get("bias"),
            slow=SlowExtrapolation(arrays.get("slow"), arrays.get("contraction")),
        )
