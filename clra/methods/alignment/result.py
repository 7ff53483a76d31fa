"""What an alignment returns."""

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from clra.errors import InputError
from clra.findings import Finding
from clra.methods.alignment.reprojection import Registered
from clra.model.gauge.gauge import GaugeFit
from clra.model.motion import Motion

Floats = NDArray[np.float64]

PREALIGNED = "PA"
"""Level of a history's entry for what is found before the first reconstruction."""


@dataclass(frozen=True)
class Iteration:
    """One iteration of re-projection alignment; lengths in pixels of the full-resolution detector.

    Attributes
    ----------
    level : str
        "SR", "ER", "QR", "HR" or "FR"; "PA" for a pre-alignment, whose correlation and residual
        are those of the rows' sums.
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


class SupportsAsDict(Protocol):
    """What is known of how far an alignment can be trusted; plain values describe it."""

    def as_dict(self) -> dict[str, Any]:
        """Return plain values, for JSON."""
        ...


def finished(history: Sequence[Iteration]) -> str:
    """Say what is finished: "2 iterations, the last at HR"."""
    count = len(history)
    if history[-1].level == PREALIGNED:
        return "the pre-alignment"
    return f"{count} iteration{'s' * (count > 1)}, the last at {history[-1].level}"


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class AlignmentResult:
    """What alignment found, how good it is and where it comes from.

    :func:`clra.write_alignment` and :func:`clra.read_alignment` keep all of it;
    :func:`clra.reconstruct` and :func:`clra.correct` take it as it is.

    Attributes
    ----------
    motion : Motion
        Of each view, in pixels of the full-resolution detector; mean(log magnification) = 0.
    valid_views : ndarray of bool, (views,)
        Views whose registration is accepted. The others have their neighbours' motion, and are left
        out of reconstructions.
    confidence : ndarray, (views,)
        Correlation of each measured radiograph with its simulated counterpart in the band used,
        clipped to 0..1, after the last registration; 0 for rejected views.
    sigma : ndarray, (views, 3)
        Standard errors of shift_u, shift_v [pixel] and magnification; NaN where not estimated.
    history : tuple of Iteration
        One entry an iteration.
    gauge : dict of str to float
        RMS [pixel] of the part of the last estimate that each movement of the sample as a whole
        explains. The data hardly see that part; the volume is as sharp with it as without. With
        ``gauge="anchored"`` it is not in `motion` any more.
    quality : SupportsAsDict, optional
        How far to trust it, where that was measured.
    warnings : tuple of Finding
        What was found on the way that tells against the result or the scan.
    volume : ndarray of float32, (nz, ny, nx), optional
        Attenuation [1/mm], where the method reconstructs as it aligns.
    method, schedule, estimate : str
        What was run; "" where it is not known.
    device : str
        On what.
    command : str
        The command line or the call.
    versions : dict of str to str
        Of "clra", "pyopencl" and the device's "driver".
    scan, checksum : str
        Name of the scan, and :meth:`Scan.checksum` of it.
    about : dict of str to str
        What else is known of the run, such as "unobservable" (whether the gauge was "taken out" of
        the motion or "left in"), or where an auto-focus found the detector.
    """

    motion: Motion
    valid_views: NDArray[np.bool_]
    confidence: Floats
    sigma: Floats
    history: tuple[Iteration, ...] = ()
    gauge: Mapping[str, float] = field(default_factory=dict)
    quality: SupportsAsDict | None = None
    warnings: tuple[Finding, ...] = ()
    volume: NDArray[np.float32] | None = None
    method: str = ""
    schedule: str = ""
    estimate: str = ""
    device: str = ""
    command: str = ""
    versions: Mapping[str, str] = field(default_factory=dict)
    scan: str = ""
    checksum: str = ""
    about: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        views = self.motion.views
        for name, shape in (("valid_views", (views,)), ("confidence", (views,))):
            if getattr(self, name).shape != shape:
                found = getattr(self, name).shape
                raise InputError(f"{name}: found shape {found}, expected {shape} as in motion")
        if self.sigma.ndim != 2 or len(self.sigma) != views:
            raise InputError(f"sigma: found shape {self.sigma.shape}, expected ({views}, 3)")

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
            valid_views=~rejected,
            history=tuple(history),
            confidence=np.clip(np.where(rejected, 0.0, registered.correlation), 0.0, 1.0),
            sigma=registered.sigma,
            gauge=dict(gauge.rms_by_mode),
            schedule=schedule,
            device=device.strip(),
        )

    @classmethod
    def from_motion(
        cls, motion: Motion, valid_views: NDArray[np.bool_] | None = None
    ) -> "AlignmentResult":
        """Return a result for a motion that is known from elsewhere.

        Parameters
        ----------
        motion : Motion
            Of each view.
        valid_views : ndarray of bool, (views,), optional
            All by default.
        """
        valid = np.ones(motion.views, np.bool_) if valid_views is None else valid_views
        return cls(
            motion=motion,
            valid_views=valid,
            confidence=valid.astype(np.float64),
            sigma=np.full((motion.views, 3), np.nan),
        )

    @property
    def flagged(self) -> tuple[int, ...]:
        """Rejected views, from 0."""
        return tuple(np.flatnonzero(~self.valid_views).tolist())

    def checksum_of_motion(self) -> str:
        """Return a checksum of the motion and the valid views: what a reconstruction takes."""
        motion = self.motion
        digest = hashlib.sha256(motion.cause.encode())
        for column in motion.columns():
            digest.update(np.ascontiguousarray(column, "<f8").tobytes())
        digest.update(self.valid_views.tobytes())
        return f"sha256:{digest.hexdigest()}"

    @property
    def scale_estimated(self) -> bool:
        """Whether magnifications were estimated."""
        return bool(np.any(self.motion.magnification != 1))

    @property
    def median_sigma(self) -> tuple[float, float, float] | None:
        """Medians over the views of the standard errors, where they are known."""
        known = self.sigma[np.isfinite(self.sigma[:, :2]).all(axis=1), :3]
        if not len(known):
            return None
        u, v, m = np.median(known, axis=0).tolist()
        return u, v, m

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, AlignmentResult):
            return NotImplemented
        return all(
            _same(getattr(self, f.name), getattr(other, f.name)) for f in fields(AlignmentResult)
        )

    def __repr__(self) -> str:
        u, v = (np.median(np.abs(s)) for s in (self.motion.shift_u, self.motion.shift_v))
        verdict = getattr(self.quality, "verdict", "")
        parts = (
            f"{self.motion.views} views",
            f"{len(self.flagged)} rejected",
            f"median |shift| {u:.2f}, {v:.2f} pixel",
            " ".join(filter(None, (self.method, self.schedule))),
            f"{len(self.history)} iterations" if self.history else "",
            f"{len(self.warnings)} warnings" if self.warnings else "",
            verdict,
        )
        return f"AlignmentResult({', '.join(filter(None, parts))})"


def _same(one: Any, other: Any) -> bool:
    """Whether two values of a field are equal; NaN, not estimated, equals itself."""
    if hasattr(one, "as_dict") and hasattr(other, "as_dict"):
        return json.dumps(one.as_dict()) == json.dumps(other.as_dict())  # NaN equals NaN there
    if not (isinstance(one, np.ndarray) and isinstance(other, np.ndarray)):
        return type(one) is type(other) and bool(one == other)
    numbers = one.dtype.kind == "f" and other.dtype.kind == "f"
    return np.array_equal(one, other, equal_nan=numbers)


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
