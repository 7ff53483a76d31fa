"""What is corrected in a scan's radiographs, and how: one place, where they are read."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clra.errors import InputError
from clra.findings import Finding
from clra.model.bad_pixels import Patches
from clra.model.corrections.air_region import AirRegion
from clra.model.corrections.zingers import replace_zingers

Floats = NDArray[np.float32]
Mask = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Corrections:
    """Corrections of line integrals p of a scan, in the order in which they are made.

    Zingers are replaced, bad pixels interpolated, the line integral of the air in the view and the
    error of the pixel subtracted, and beam hardening undone by ``p + c1 p^2 + c2 p^3 + ...``.

    Parameters
    ----------
    zingers : bool
        Replace single pixels that are far brighter than all around them.
    bad : ndarray of bool, (rows, columns), optional
        True where a pixel does not show the sample.
    air : AirRegion, optional
        Where the detector looks past the sample: what the beam lost against the flat field.
    rings : ndarray, (rows, columns), optional
        Error of each pixel that is the same in all views.
    beam_hardening : tuple of float
        Coefficients c1, c2, ... of the polynomial.
    excluded : tuple of int
        Views that are not to be used.
    findings : tuple of Finding
        What was found in the radiographs.
    """

    zingers: bool = False
    bad: Mask | None = None
    air: AirRegion | None = None
    rings: Floats | None = None
    beam_hardening: tuple[float, ...] = ()
    excluded: tuple[int, ...] = ()
    findings: tuple[Finding, ...] = ()

    def __str__(self) -> str:
        """Return what is corrected, on a line of JSON."""
        return json.dumps(self.contents())

    def check(self, shape: tuple[int, int], name: str) -> None:
        """Raise an InputError if an array does not fit a detector of (rows, columns)."""
        for field in ("bad", "rings"):
            values = getattr(self, field)
            if values is not None and values.shape != shape:
                raise InputError(
                    f"{name}: corrections.{field}: found shape {values.shape}, expected {shape}"
                )
        if self.bad is not None and self.bad.all():
            raise InputError(f"{name}: corrections.bad: found no good pixel, expected some")

    def apply(self, pixels: Floats) -> Floats:
        """Correct line integrals.

        Parameters
        ----------
        pixels : ndarray of float32, (n, rows, columns)
            Left as they are.

        Returns
        -------
        ndarray of float32, (n, rows, columns)
        """
        pixels = pixels.copy()
        patches = self._patches
        for image in pixels:
            # Before a bad pixel gets a part of one.
            if self.zingers:
                replace_zingers(image)
            if patches is not None:
                patches.fill(image)
            if self.air is not None:
                image -= np.float32(self.air.level(image))
            if self.rings is not None:
                image -= self.rings
            if self.beam_hardening:
                image[...] = linearised(image, self.beam_hardening)
        return pixels

    def contents(self) -> dict[str, Any]:
        """Return what is corrected, as plain values: for records of what was done."""
        return {
            "zingers": self.zingers,
            "bad_pixels": 0 if self.bad is None else int(self.bad.sum()),
            "intensity": [] if self.air is None else [list(tile) for tile in self.air.tiles],
            "rings": self.rings is not None,
            "beam_hardening": list(self.beam_hardening),
            "excluded": list(self.excluded),
        }

    @property
    def unreliable(self) -> Mask | None:
        """Bad pixels whose neighbours do not tell their values, (rows, columns); None if none."""
        found = None if self._patches is None else self._patches.unreliable
        return None if found is None or not found.any() else found

    def masked(self, mask: Mask | None) -> Corrections:
        """Return those in which the pixels that a mask leaves out are bad as well."""
        if mask is None or mask.all():
            return self
        bad = ~mask if self.bad is None else ~mask | self.bad
        return replace(self, bad=~mask if bad.all() else bad)

    def cropped(self, rows: slice, columns: slice) -> Corrections:
        """Return those of a rectangle of the detector."""
        return replace(
            self,
            bad=None if self.bad is None else self.bad[rows, columns],
            air=None if self.air is None else self.air.cropped(rows, columns),
            rings=None if self.rings is None else self.rings[rows, columns],
        )

    @cached_property
    def _patches(self) -> Patches | None:
        return None if self.bad is None or not self.bad.any() else Patches(self.bad)


def linearised(pixels: Floats, coefficients: tuple[float, ...]) -> Floats:
    """Return ``p + c1 p^2 + c2 p^3 + ...`` of line integrals p, by Horner's rule."""
    factor = np.zeros_like(pixels)
    for coefficient in reversed(coefficients):
        factor += np.float32(coefficient)
        factor *= pixels
    return pixels + factor * pixels
