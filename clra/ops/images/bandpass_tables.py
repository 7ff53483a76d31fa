"""Tables of the band-pass, computed on the host: weights of masks, planes and splines."""

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


def reciprocal(counts: Floats, taps: Floats) -> Floats:
    """1 / (mask convolved with the taps), 0 where a tenth of the neighbourhood or less counts."""
    from scipy.ndimage import correlate1d

    for axis in (0, 1):
        counts = correlate1d(counts, taps, axis, mode="constant")
    return np.divide(1.0, counts, out=np.zeros_like(counts), where=counts > 0.1)


def plane_fit(counts: Floats, taps: Floats) -> Floats:
    """Factors (3, rows, columns) that make the fitted plane's value of the moments 1, u, v."""
    from scipy.ndimage import correlate1d

    place = np.arange(taps.size) - taps.size // 2

    def moment(u: int, v: int) -> Floats:
        part = correlate1d(counts, taps * place**v, 0, mode="constant")
        return np.asarray(correlate1d(part, taps * place**u, 1, mode="constant"))

    whole = moment(0, 0)
    # Where pixels that count lie in one line or point, the plane's slope across it is let go.
    flat = 1e-6 * whole
    first_u, first_v, cross = moment(1, 0), moment(0, 1), moment(1, 1)
    matrix = np.array(
        [
            [whole, first_u, first_v],
            [first_u, moment(2, 0) + flat, cross],
            [first_v, cross, moment(0, 2) + flat],
        ]
    ).transpose(2, 3, 0, 1)
    matrix[whole < 1e-4] = np.eye(3)
    factors = np.linalg.inv(matrix)[..., 0]
    factors[whole < 1e-4] = 0
    return np.asarray(factors.transpose(2, 0, 1))


def spline_table(
    columns: int, factor: int, block: int, rim: int
) -> tuple[Floats, NDArray[np.intp]]:
    """Weights (span, columns) of coarse columns from each block's first on, and these (blocks,)."""
    fine = np.arange(columns)
    place = (fine - (factor - 1) / 2) / factor + rim
    base = np.floor(place).astype(np.intp)
    f = place - base
    taps4 = [(1 - f) ** 3, 4 - 6 * f**2 + 3 * f**3, 1 + 3 * f + 3 * f**2 - 3 * f**3, f**3]
    bases = base[::block] - 1
    first = base - 1 - bases[fine // block]
    weights = np.zeros((int(first.max()) + 4, columns))
    for k, tap in enumerate(taps4):
        weights[first + k, fine] = tap / 6
    return weights, bases
