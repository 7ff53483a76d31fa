"""Normal equations of rigid motion, solved view by view.

All that views have in common is how much their noise is enlarged: their median.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from clra.ops.registration.rigid_registration import IMAGES, PRODUCTS

Floats = NDArray[np.float64]

_GAIN, _DIFFERENCE = 6, 7  # the simulated radiograph, and measured less simulated
_RIDGE = 1e-12  # of the diagonal: parameters that a view does not show stay 0
# White noise behind a low-pass of sigma s counts as one sample in 4 pi s^2 pixels; the derivatives
# have most of their power where the low-pass leaves less of the noise, between 1/2 for white ones
# and 1/sqrt(2) for those of edges. Estimates from noisy re-projections of balls scatter so.
_IN_BAND = 0.6
# Bands of rows below which their scatter says nothing; and the part of its variance that stays once
# the bias is taken off. Balls of equal contrast scatter 3 times as much as white noise would, a
# rock 40 times in v, a dense ball with faint ones inside 200 times in the rotation about u.
_FEW, _STAYS = 4, 0.06


@dataclass(frozen=True)
class RigidStep:
    """What the views ask for, and how well they tell it.

    Attributes
    ----------
    table : ndarray, (views, 6)
        Translations [mm] and rotations [rad], as in `clra.model.rigid.rigid_motion.PARAMETERS`.
    sigma : ndarray, (views, 6)
        Standard errors of the noise, the prior included; NaN where not estimated.
    alone : ndarray, (views, 6)
        The same without the prior.
    correlation : ndarray, (views,)
        Of the measured and the simulated radiograph, before the step.
    residual : ndarray, (views,)
        Root mean square of what is left after it [attenuation].
    """

    table: Floats
    sigma: Floats
    alone: Floats
    correlation: Floats
    residual: Floats

    def less(self, bias: Floats) -> "RigidStep":
        """Return the step without what is found where nothing moved."""
        return replace(self, table=self.table - bias)


def equations(totals: Floats, free: tuple[int, ...], weight: float, low_pass: float) -> Floats:
    """Sum normal equations up, and how much bands of rows differ in what they ask for.

    Parameters
    ----------
    totals : ndarray, (views, blocks, 36)
        As `clra.ops.registration.rigid_registration.RigidRegistration` gives them.
    free : tuple of int
        Parameters to estimate; a gain is always fitted.
    weight : float
        Sum of the weights of the pixels.
    low_pass : float
        Sigma of the band-pass that the images are behind [pixel].

    Returns
    -------
    ndarray, (views, 36 + 2 + parameters + 1)
        A row a view: totals of all blocks, `weight`, the variance of the noise, and for each
        parameter and the gain the variance among blocks, in those that the noise makes.
    """
    correlated = max(1.0, _IN_BAND * 4 * np.pi * low_pass**2)  # pixels that count as one sample
    products = totals.sum(axis=1)
    system = _System(products, free)
    plain = np.einsum("nij,nj->ni", system.inverse, system.right)
    noise = correlated * system.variance(plain, weight)
    scatter = np.zeros_like(plain)
    if totals.shape[1] >= _FEW:
        unknown = [*free, _GAIN]
        rows = _symmetric(totals)[:, :, unknown] / system.scale[:, None, :, None]
        asked = rows[..., _DIFFERENCE] - np.einsum(
            "nbij,nj->nbi", rows[..., unknown], plain / system.scale
        )
        by_noise = noise[:, None] * np.einsum("nii->ni", system.inverse)
        scatter = _scatter(asked, system.inverse) / np.maximum(by_noise, 1e-300)
    return np.column_stack([products, np.full(len(noise), weight), noise, scatter])


def solve(rows: Floats, free: tuple[int, ...], prior: Floats) -> RigidStep:
    """Solve the normal equations.

    Parameters
    ----------
    rows : ndarray, (views, 36 + 2 + parameters + 1)
        Of all views, as :func:`equations` gives them.
    free : tuple of int
        Parameters to estimate.
    prior : ndarray, (6,)
        Expected standard deviation of each step; 0 for unknown.
    """
    products, (weight, noise) = rows[:, :PRODUCTS], rows[:, PRODUCTS : PRODUCTS + 2].T
    scatter = rows[:, PRODUCTS + 2 :]
    views, count = len(rows), len(free)
    system = _System(products, free)
    scale, square = system.scale, system.square
    grown = np.maximum(1.0, _STAYS * np.median(scatter, axis=0))
    known = np.zeros((views, count + 1))
    some = np.append(prior[list(free)] > 0, False)
    known[:, some] = noise[:, None] * grown[some] / prior[list(free)][some[:-1]] ** 2
    held = system.normal + np.einsum("ni,ij->nij", known / scale**2, np.eye(count + 1))
    inverse = np.linalg.inv(held)
    x = np.einsum("nij,nj->ni", inverse, system.right)
    table, sigma, alone = np.zeros((views, 6)), *np.full((2, views, 6), np.nan)
    table[:, list(free)] = (x / scale)[:, :count]
    for errors, covariance in ((sigma, inverse), (alone, system.inverse)):
        spread = np.sqrt(noise[:, None] * grown * np.einsum("nii->ni", covariance)) / scale
        errors[:, list(free)] = spread[:, :count]
    own, with_difference = (system.gram[:, _GAIN, k] for k in (_GAIN, _DIFFERENCE))
    measured = own + 2 * with_difference + square
    correlation = (own + with_difference) / np.sqrt(np.maximum(own * measured, 1e-300))
    return RigidStep(table, sigma, alone, correlation, np.sqrt(system.variance(x, weight)))


class _System:
    """Normal equations of each view in units in which the unknowns have one length."""

    def __init__(self, products: Floats, free: tuple[int, ...]) -> None:
        unknown = [*free, _GAIN]
        self.gram = _symmetric(products)
        # Millimetres and radians differ by orders of magnitude.
        own = np.einsum("nii->ni", self.gram)[:, unknown]
        self.scale = np.sqrt(np.maximum(own, 1e-300))
        normal = self.gram[:, unknown][:, :, unknown]
        self._plain = normal / self.scale[:, :, None] / self.scale[:, None, :]
        self.normal = self._plain + _RIDGE * np.eye(len(unknown))
        self.right = self.gram[:, unknown, _DIFFERENCE] / self.scale
        self.square = self.gram[:, _DIFFERENCE, _DIFFERENCE]
        self.inverse = np.linalg.inv(self.normal)

    def variance(self, x: Floats, weight: float | Floats) -> Floats:
        """Mean square of what a solution leaves of the difference."""
        explained = 2 * np.sum(x * self.right, axis=1)
        left = self.square - explained + np.einsum("ni,nij,nj->n", x, self._plain, x)
        return np.asarray(np.maximum(left, 1e-12 * self.square) / weight)


def _symmetric(products: Floats) -> Floats:
    """Return matrices (..., 8, 8) of their upper triangles."""
    whole = np.empty((*products.shape[:-1], IMAGES, IMAGES))
    upper = np.triu_indices(IMAGES)
    whole[..., upper[0], upper[1]] = whole[..., upper[1], upper[0]] = products
    return whole


def _scatter(asked: Floats, inverse: Floats) -> Floats:
    """Return variances of a solution by how bands of rows differ in what they still ask for."""
    bands = asked.shape[1]
    steps = np.einsum("nij,nbj->nbi", inverse, asked)
    return np.asarray(np.sum(steps**2, axis=1) * bands / (bands - 1))
