"""What a multigrid reconstruction tells of its steps, goes on from, and returns."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from clra.methods.alignment.result import AlignmentResult, Iteration
from clra.model.motion import Motion
from clra.ops.streaming.volume import Volume


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
    volume : Volume or None
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
    """

    volume: Volume | None
    motion: Motion
    rejected: NDArray[np.bool_]
    steps: tuple[ImgrStep, ...] = ()
    history: tuple[Iteration, ...] = ()
    ended: bool = False


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
    volume : Volume
        Attenuation [1/mm].
    motion : Motion
        Of the radiographs, estimated or given.
    steps : tuple of ImgrStep
        Of the run.
    alignment : AlignmentResult or None
        Where it aligned.
    """

    volume: Volume
    motion: Motion
    steps: tuple[ImgrStep, ...]
    alignment: AlignmentResult | None
