"""Lags of profiles against closed forms."""

import numpy as np
import pytest

from clra.methods.alignment.prealignment.lags import best_lags

ROW = np.arange(60.0)


def _hill(middle):
    return np.exp(-0.5 * ((ROW - middle) / 4.0) ** 2) + 0.5 * np.exp(
        -0.5 * ((ROW - middle - 14) / 2.5) ** 2
    )


@pytest.mark.parametrize("gain", [False, True])
def test_lags_are_found_to_a_part_of_a_pixel(gain):
    true = np.array([-11.0, -3.25, 0.0, 6.5, 15.3])
    factor = 1.7 if gain else 1.0
    first = np.tile(_hill(22.0), (len(true), 1))
    second = factor * np.stack([_hill(22.0 + lag) for lag in true])
    expected = np.rint(true).astype(int) + np.array([3, -2, 0, 1, -4])
    np.testing.assert_allclose(best_lags(first, second, expected, 15, gain=gain), true, atol=0.12)


def test_air_does_not_fit_better_than_the_sample():
    # With a lag of 40 rows only air would be compared, and it is the same everywhere.
    lag = best_lags(_hill(12.0)[None], 1.01 * _hill(17.0)[None], np.zeros(1, int), 10)
    assert lag == pytest.approx([5.0], abs=0.1)
