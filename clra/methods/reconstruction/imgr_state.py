"""What a multigrid reconstruction tells of its steps, goes on from, and returns."""

from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clra.methods.alignment.reprojection import Registered
from clra.methods.alignment.result import AlignmentResult, Iteration
from clra.methods.execution.checkpoint import Checkpoint, Saved
from clra.methods.execution.packing import (
    history_from,
    history_values,
    motion_arrays,
    motion_from,
    registered_arrays,
    registered_from,
)
from clra.model.motion import Motion
from clra.model.schedule import level_factor
from clra.ops.streaming.volume import PlaneSource


@dataclass(frozen=True)
class ImgrStep:
    """One level of one cycle.

    Attributes
    ----------
    cycle : int
        From 1.
    level : str
        "ER", "QR", "HR" or "FR".
    misfit : float
        Mean Poisson deviance of a ray, of the volume that the level began with.
    seconds : float
        Time it took.
    """

    cycle: int
    level: str
    misfit: float
    seconds: float


@dataclass(frozen=True)
class ImgrState:
    """What the levels finished so far gave: all that the next one needs.

    Attributes
    ----------
    volume : PlaneSource or None
        At the resolution of the last level, on the grid with its margin.
    motion : Motion
        Of the radiographs.
    rejected : ndarray of bool, (views,)
        Radiographs that are rejected; they are left out.
    steps : tuple of ImgrStep
        Finished ones.
    history : tuple of Iteration
        Their alignment.
    ended : bool
        Whether it has converged, or had all its cycles.
    registered : Registered or None
        What the last registration found, if there was one.
    found : Motion or None
        By that registration, with its gauge.
    """

    volume: PlaneSource | None
    motion: Motion
    rejected: NDArray[np.bool_]
    steps: tuple[ImgrStep, ...] = ()
    history: tuple[Iteration, ...] = ()
    ended: bool = False
    registered: Registered | None = None
    found: Motion | None = None

    @property
    def finished(self) -> str:
        """Say what is finished."""
        last = self.steps[-1]
        return f"cycle {last.cycle} up to {last.level}"

    def keep(self, checkpoint: Checkpoint) -> None:
        """Keep it on disk."""
        arrays = motion_arrays("motion", self.motion) | registered_arrays(self.registered)
        arrays["rejected"] = self.rejected
        if self.found is not None:
            arrays |= motion_arrays("found", self.found)
        values = {
            "cause": self.motion.cause,
            "steps": [asdict(step) for step in self.steps],
            "history": history_values(self.history),
            "ended": self.ended,
        }
        checkpoint.save(self.finished, values, arrays, self.volume)

    @classmethod
    def kept(cls, saved: Saved, restored: Callable[[int, Any], PlaneSource]) -> "ImgrState":
        """Return a state that was kept.

        Parameters
        ----------
        saved : Saved
            What was kept.
        restored : callable
            Makes a volume of the binning of its level and its planes.
        """
        arrays, values = saved.arrays, saved.values
        steps = tuple(ImgrStep(**step) for step in values["steps"])
        cause = values["cause"]
        return cls(
            volume=restored(level_factor(steps[-1].level), saved.planes),
            motion=motion_from(arrays, "motion", cause),
            rejected=arrays["rejected"],
            steps=steps,
            history=tuple(history_from(values["history"])),
            ended=values["ended"],
            registered=registered_from(arrays),
            found=motion_from(arrays, "found", cause) if "found" in arrays else None,
        )


class ReconstructionInterrupted(KeyboardInterrupt):
    """Ctrl-C after at least one level.

    Attributes
    ----------
    state : ImgrState
        To go on from.
    alignment : AlignmentResult or None
        What the finished levels gave, where they aligned.
    """

    def __init__(self, state: ImgrState, alignment: AlignmentResult | None) -> None:
        super().__init__("reconstruction was interrupted")
        self.state = state
        self.alignment = alignment


@dataclass(frozen=True)
class MultigridResult:
    """What IMGR found.

    Attributes
    ----------
    volume : PlaneSource
        Attenuation [1/mm].
    motion : Motion
        Of the radiographs, estimated or given.
    steps : tuple of ImgrStep
        Of the run.
    alignment : AlignmentResult or None
        Where it aligned.
    """

    volume: PlaneSource
    motion: Motion
    steps: tuple[ImgrStep, ...]
    alignment: AlignmentResult | None
