"""Which corrections a user asks for."""

from __future__ import annotations

import math
from dataclasses import dataclass

from clra.errors import InputError


@dataclass(frozen=True)
class CorrectionOptions:
    """Which defects of a scan are looked for and corrected before anything else is done.

    Parameters
    ----------
    bad_pixels : bool
        Find pixels and lines that do not show the sample, and interpolate them from their
        neighbours.
    zingers : bool
        Replace single bright pixels of single radiographs.
    intensity : bool
        Where the sides of the detector look past the sample, set the line integrals there to zero
        in every view: a beam that decays or flickers else adds to the attenuation.
    rings : bool
        Subtract what the mean of all views has beyond its running median along the rows. Structures
        on the rotation axis are in that as well, where nothing moves; so this is off by default.
    beam_hardening : tuple of float
        Coefficients c1, c2, ... of a calibration, by which line integrals p become
        ``p + c1 p^2 + c2 p^3 + ...``; none by default.
    exclude : tuple of int
        Views that are not to be used, from 0.
    """

    bad_pixels: bool = True
    zingers: bool = True
    intensity: bool = True
    rings: bool = False
    beam_hardening: tuple[float, ...] = ()
    exclude: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        if not all(map(math.isfinite, self.beam_hardening)):
            raise InputError(
                f"beam_hardening: found {self.beam_hardening}, expected finite coefficients"
            )

    @classmethod
    def none(cls) -> CorrectionOptions:
        """Return options that leave the radiographs as they are."""
        return cls(bad_pixels=False, zingers=False, intensity=False)
