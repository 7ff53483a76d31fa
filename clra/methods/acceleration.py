"""Anderson acceleration of a fixed-point iteration."""

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

# Tikhonov weight relative to the squared length of each difference: at a tenth of it random motions
# make the extrapolation noisy, at ten times it slow modes stay slow.
_DAMPING = 1e-3
# An extrapolated step longer than this many plain ones is not believed.
_LONGEST = 3.0


class Anderson:
    """Extrapolate ``x <- x + f(x)`` from its last few steps (type II, windowed).

    The next point is ``x + f - (dX + dF) g`` with g the damped least-squares solution of
    ``dF g = f``, dX and dF the last differences of x and f. The first step is plain: the
    extrapolation would otherwise learn from the one step whose reconstruction was blurred.

    Parameters
    ----------
    memory : int
        Differences kept; 0 leaves the iteration plain.
    floor : float
        Steps below this length are always believed, in the units of x.

    References
    ----------
    .. [1] H. F. Walker, P. Ni, "Anderson acceleration for fixed-point iterations", SIAM J. Numer.
       Anal. 49, 1715 (2011).
    """

    def __init__(self, memory: int = 3, *, floor: float = 0.5) -> None:
        self.memory = memory
        self.floor = floor
        self._last: tuple[Floats, Floats] | None = None
        self._differences: list[tuple[Floats, Floats]] = []

    def restart(self) -> None:
        """Go on with another f whose differences resemble those of the one before.

        What an iteration at one resolution learnt of slow modes holds at the next one, but the step
        across says more of the two levels' errors than of either.
        """
        self._last = None

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
        if np.abs(step).max() > _LONGEST * max(float(np.abs(f).max()), self.floor):
            return x + f
        return np.asarray(x + step)
