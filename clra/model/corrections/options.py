"""Which corrections a user asks for."""

from __future__ import annotations

from dataclasses import dataclass


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
    """

    bad_pixels: bool = True
    zingers: bool = True

    @classmethod
    def none(cls) -> CorrectionOptions:
        """Return options that leave the radiographs as they are."""
        return cls(bad_pixels=False, zingers=False)
