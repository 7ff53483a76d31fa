"""Normal equations of rigid motion, solved view by view."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from clra.ops.registration.rigid_registration import IMAGES

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


def solve(
    totals: Floats, free: tuple[int, ...], prior: Floats, weight: float, low_pass: float
) -> RigidStep:
    """Solve the normal equations.

    Parameters
    ----------
    totals : ndarray, (views, blocks, 36)
        As `clra.ops.registration.rigid_registration.RigidRegistration` gives them.
    free : tuple of int
        Parameters to estimate; a gain is always fitted.
    prior : ndarray, (6,)
        Expected standard deviation of each step; 0 for unknown.
    weight : float
        Sum of the weights of the pixels.
    low_pass : float
        Sigma of the band-pass that the images are behind [pixel].
    """
    correlated = max(1.0, _IN_BAND * 4 * np.pi * low_pass**2)  # pixels that count as one sample
    views, blocks, count = *totals.shape[:2], len(free)
    bands = np.empty((views, blocks, IMAGES, IMAGES))
    upper = np.triu_indices(IMAGES)
    bands[..., upper[0], upper[1]] = bands[..., upper[1], upper[0]] = totals
    gram = bands.sum(axis=1)
    unknown = [*free, _GAIN]
    # Of one length each, or millimetres and radians differ by orders of magnitude.
    scale = np.sqrt(np.maximum(np.einsum("nii->ni", gram)[:, unknown], 1e-300))
    normal = gram[:, unknown][:, :, unknown] / scale[:, :, None] / scale[:, None, :]
    right = gram[:, unknown, _DIFFERENCE] / scale
    square = gram[:, _DIFFERENCE, _DIFFERENCE]
    ridge = _RIDGE * np.eye(count + 1)

    def variance(x: Floats) -> Floats:
        left = square - 2 * np.sum(x * right, axis=1) + np.einsum("ni,nij,nj->n", x, normal, x)
        return np.asarray(np.maximum(left, 1e-12 * square) / weight)

    whole = np.linalg.inv(normal + ridge)
    plain = np.einsum("nij,nj->ni", whole, right)
    noise = correlated * variance(plain)
    grown = np.ones(count + 1)
    if blocks >= _FEW:
        rows = bands[:, :, unknown] / scale[:, None, :, None]
        asked = rows[..., _DIFFERENCE] - np.einsum(
            "nbij,nj->nbi", rows[..., unknown], plain / scale
        )
        by_noise = np.maximum(noise[:, None] * np.einsum("nii->ni", whole), 1e-300)
        grown = np.maximum(1.0, _STAYS * np.median(_scatter(asked, whole) / by_noise, axis=0))
    known = np.zeros((views, count + 1))
    some = np.append(prior[list(free)] > 0, False)
    known[:, some] = noise[:, None] * grown[some] / prior[list(free)][some[:-1]] ** 2
    held = normal + ridge + np.einsum("ni,ij->nij", known / scale**2, np.eye(count + 1))
    inverse = np.linalg.inv(held)
    x = np.einsum("nij,nj->ni", inverse, right)
    table, sigma, alone = np.zeros((views, 6)), *np.full((2, views, 6), np.nan)
    table[:, list(free)] = (x / scale)[:, :count]
    for errors, covariance in ((sigma, inverse), (alone, whole)):
        spread = np.sqrt(noise[:, None] * grown * np.einsum("nii->ni", covariance)) / scale
        errors[:, list(free)] = spread[:, :count]
    own = gram[:, _GAIN, _GAIN]
    crossed = own + gram[:, _GAIN, _DIFFERENCE]
    measured = own + 2 * gram[:, _GAIN, _DIFFERENCE] + square
    correlation = crossed / np.sqrt(np.maximum(own * measured, 1e-300))
    return RigidStep(table, sigma, alone, correlation, np.sqrt(variance(x)))


def _scatter(asked: Floats, inverse: Floats) -> Floats:
    """Return variances of a solution by how bands of rows differ in what they still ask for."""
    bands = asked.shape[1]
    steps = np.einsum("nij,nbj->nbi", inverse, asked)
    return np.asarray(np.sum(steps**2, axis=1) * bands / (bands - 1))
