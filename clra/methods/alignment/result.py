"""What an alignment returns."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clra.methods.alignment.reprojection import Registered
from clra.model.gauge.gauge import GaugeFit
from clra.model.motion import Motion

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Iteration:
    """One iteration of re-projection alignment; lengths in pixels of the full-resolution detector.

    Attributes
    ----------
    level : str
        "QR", "HR" or "FR".
    iteration : int
        From 1 at each level.
    update_u_median, update_v_median, update_max : float
        Medians of |change of the shift| in u and v that the registration asks for, and the largest
        in either.
    correlation, residual : float
        Medians over the views, after registration.
    seconds : float
        Time it took.
    mae_u, mae_v, mae_m, gauge_free_u, gauge_free_v, gauge_free_m : float or None
        Mean absolute errors after the iteration where the truth is known.
    misfit : float or None
        Of iterative reconstruction: mean Poisson deviance of a ray before the volume's update.
    note : str
        What was warned of, a line each: motions out of reach, features that the level loses.
    """

    level: str
    iteration: int
    update_u_median: float
    update_v_median: float
    update_max: float
    correlation: float
    residual: float
    seconds: float
    mae_u: float | None = None
    mae_v: float | None = None
    mae_m: float | None = None
    gauge_free_u: float | None = None
    gauge_free_v: float | None = None
    gauge_free_m: float | None = None
    misfit: float | None = None
    note: str = ""

    @classmethod
    def of(
        cls,
        level: str,
        iteration: int,
        update: Floats,
        correlation: Floats,
        residual: Floats,
        seconds: float,
        **more: Any,
    ) -> "Iteration":
        """Sum an iteration up; of `update`, (2, views), the size counts."""
        size = np.abs(update)
        return cls(
            level=level,
            iteration=iteration,
            update_u_median=float(np.median(size[0])),
            update_v_median=float(np.median(size[1])),
            update_max=float(size.max()),
            correlation=float(np.median(correlation)),
            residual=float(np.median(residual)),
            seconds=seconds,
            **more,
        )


@dataclass(frozen=True)
class AlignmentResult:
    """What alignment found and how good it is.

    Attributes
    ----------
    motion : Motion
        Of each view, in pixels of the full-resolution detector; mean(log magnification) = 0.
    history : list of Iteration
        One entry an iteration.
    confidence : ndarray, (views,)
        Correlation of each measured radiograph with its simulated counterpart in the band used,
        clipped to 0..1, after the last registration.
    sigma : ndarray, (views, 3)
        Standard errors of shift_u, shift_v [pixel] and magnification, from that registration.
    gauge : dict of str to float
        RMS [pixel] of the part of the last estimate that each movement of the sample as a whole
        explains. The data hardly see that part; the volume is as sharp with it as without. With
        ``gauge="anchored"`` it is not in `motion` any more.
    flagged : tuple of int
        Views whose registration is rejected; they have their neighbours' motion.
    schedule, device : str
        What was run, and on what.
    volume : ndarray of float32, (nz, ny, nx), optional
        Attenuation [1/mm], where the method reconstructs as it aligns.
    """

    motion: Motion
    history: list[Iteration]
    confidence: Floats
    sigma: Floats
    gauge: dict[str, float]
    flagged: tuple[int, ...]
    schedule: str
    device: str
    volume: NDArray[np.float32] | None = None

    @classmethod
    def of(
        cls,
        motion: Motion,
        history: Sequence[Iteration],
        registered: Registered,
        rejected: NDArray[np.bool_],
        gauge: GaugeFit,
        schedule: str,
        device: str,
    ) -> "AlignmentResult":
        """Sum up what the last registration found; views that are `rejected` have no confidence."""
        return cls(
            motion=motion,
            history=list(history),
            confidence=np.clip(np.where(rejected, 0.0, registered.correlation), 0.0, 1.0),
            sigma=registered.sigma,
            gauge=dict(gauge.rms_by_mode),
            flagged=tuple(int(view) for view in np.flatnonzero(rejected)),
            schedule=schedule,
            device=device.strip(),
        )


class AlignmentInterrupted(KeyboardInterrupt):
    """Ctrl-C during alignment.

    Attributes
    ----------
    result : AlignmentResult
        What the iterations that were finished gave.
    """

    def __init__(self, result: AlignmentResult) -> None:
        super().__init__("alignment was interrupted")
        self.result = result
