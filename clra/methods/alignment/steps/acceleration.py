"""Anderson acceleration of a fixed-point iteration."""

import numpy as np
from numpy.typing import NDArray

from clra.model.motion import Motion

Floats = NDArray[np.float64]

# Tikhonov weight relative to the squared length of each difference: at a tenth of it random motions
# make the extrapolation noisy, at ten times it slow modes stay slow.
_DAMPING = 1e-3
# An extrapolated step longer than this many plain ones is rejected, where a plain one counts as at
# least so long, in the units of x.
_LONGEST, _SHORT = 3.0, 0.5


class Anderson:
    """Extrapolate ``x <- x + f(x)`` from its last few steps (type II, windowed).

    The next point is ``x + f - (dX + dF) g`` with g the damped least-squares solution of
    ``dF g = f``, dX and dF the last differences of x and f. The first step is plain: the
    extrapolation would otherwise learn from the one step whose reconstruction was blurred.

    Parameters
    ----------
    memory : int
        Differences kept; 0 leaves the iteration plain.

    References
    ----------
    .. [1] H. F. Walker, P. Ni, "Anderson acceleration for fixed-point iterations", SIAM J. Numer.
       Anal. 49, 1715 (2011).
    """

    def __init__(self, memory: int = 3) -> None:
        self.memory = memory
        self.forget()

    def forget(self) -> None:
        """Go on as if from the first step."""
        self._last: tuple[Floats, Floats] | None = None
        self._differences: list[tuple[Floats, Floats]] = []

    def next(self, x: Floats, f: Floats) -> Floats:
        """Return the next point.

        Parameters
        ----------
        x : ndarray
            Where the iteration stands.
        f : ndarray
            The plain step from there.
        """
        if self._last is not None:
            pair = (x - self._last[0]).ravel(), (f - self._last[1]).ravel()
            self._differences = [*self._differences, pair][-self.memory :] if self.memory else []
        self._last = x, f
        if not self._differences:
            return x + f
        dx, df = (np.stack(part, axis=-1) for part in zip(*self._differences, strict=True))
        # Columns of one length: else the damping that the first, long difference needs would
        # drown the last, short ones, which are what slow modes are seen in.
        length = np.linalg.norm(df, axis=0)
        length[length == 0] = 1.0
        dx, df = dx / length, df / length
        normal = df.T @ df + _DAMPING * np.eye(df.shape[1])
        step = f - ((dx + df) @ np.linalg.solve(normal, df.T @ f.ravel())).reshape(f.shape)
        if np.abs(step).max() > _LONGEST * max(float(np.abs(f).max()), _SHORT):
            return x + f
        return np.asarray(x + step)


class MotionSteps:
    """Extrapolation of motions, all numbers written as lengths so that none rules it.

    Parameters
    ----------
    anderson : Anderson
        Which knows no steps yet.
    shape : (int, int)
        Rows and columns of the full-resolution detector.
    scale : bool
        Whether magnifications are estimated.
    """

    def __init__(self, anderson: Anderson, shape: tuple[int, int], scale: bool) -> None:
        self._anderson = anderson
        self._scale = scale
        # Pixels by which a point of middling distance from the centre moves a unit of scale.
        self._lever = 0.25 * float(np.hypot(*shape))

    def step(self, here: Motion, there: Motion) -> Floats:
        """Return the plain step in u, v and, if estimated, scale, (2 or 3, views) [pixel]."""
        return self._as_lengths(there) - self._as_lengths(here)

    def forget(self) -> None:
        """Extrapolate from no step so far."""
        self._anderson.forget()

    def next(self, here: Motion, there: Motion, *, plain: bool) -> Motion:
        """Return the next motion.

        Parameters
        ----------
        here, there : Motion
            As it was, and as the iteration finds it.
        plain : bool
            Go there, and learn nothing from it.
        """
        start, end = self._as_lengths(here), self._as_lengths(there)
        moved = end if plain else self._anderson.next(start, end - start)
        motion = Motion(
            shift_u=moved[0],
            shift_v=moved[1],
            magnification=np.exp(moved[2] / self._lever) if self._scale else None,
            cause=here.cause,
        )
        return motion.normalised()

    def _as_lengths(self, motion: Motion) -> Floats:
        rows = [motion.shift_u, motion.shift_v]
        if self._scale:
            rows.append(self._lever * np.log(motion.magnification))
        return np.stack(rows)
