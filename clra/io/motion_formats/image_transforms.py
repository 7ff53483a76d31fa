"""Motions as what other programs do to radiographs: nabu's translations, IMOD's transforms."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from clra.model.motion import Motion

Floats = NDArray[np.float64]


def nabu_translations(motion: Motion, *, cone: bool) -> Floats:
    """Return nabu's ``translation_movements_file``.

    nabu takes for row y of a corrected radiograph the recorded row y + vertical. Horizontally it
    moves the axis: its back-projection of parallel beams takes column x + horizontal, while that of
    cone beams, by ASTRA, takes x - horizontal.

    Parameters
    ----------
    motion : Motion
        nabu has no magnification.
    cone : bool
        Whether it is for nabu's cone-beam reconstruction.

    Returns
    -------
    ndarray, (views, 2)
        Horizontal and vertical [pixel].
    """
    across = -motion.shift_u if cone else motion.shift_u
    return np.stack([across, motion.shift_v], axis=1)


def imod_transforms(motion: Motion) -> Floats:
    """Return IMOD's linear transforms, which align the radiographs.

    ``X' = A11 X + A12 Y + DX``, ``Y' = A21 X + A22 Y + DY`` about the middle, Y upwards: row 0 of
    ours is the top of the images, as TIFF and ``tif2mrc`` have it.

    Parameters
    ----------
    motion : Motion
        Which the transforms undo.

    Returns
    -------
    ndarray, (views, 6)
        A11, A12, A21, A22, DX, DY, the latter two in pixels.
    """
    inverse = motion.inverse()
    m, zero = inverse.magnification, np.zeros(motion.views)
    return np.stack([m, zero, zero, m, inverse.shift_u, -inverse.shift_v], axis=1)
