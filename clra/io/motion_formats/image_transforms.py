"""Motions as what other programs do to radiographs: nabu's translations, IMOD's transforms."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from clra.errors import InputError
from clra.model.motion import Motion
from clra.model.rigid.rigid_motion import RigidMotion

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

    Raises
    ------
    InputError
        If the sample turned: no shift of a radiograph shows that.
    """
    motion = _of_images(motion, "nabu's translations")
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

    Raises
    ------
    InputError
        If the sample turned: no shift of a radiograph shows that.
    """
    inverse = _of_images(motion, "IMOD's transforms").inverse()
    m, zero = inverse.magnification, np.zeros(motion.views)
    return np.stack([m, zero, zero, m, inverse.shift_u, -inverse.shift_v], axis=1)


def _of_images(motion: Motion, what: str) -> Motion:
    """Return the shifts and magnifications of a motion without rotations."""
    if not isinstance(motion, RigidMotion):
        return motion
    if motion.rotation.any():
        raise InputError(
            f"motion: found rotations of the sample, expected shifts for {what}; 'astra', 'rtk', "
            "'cil' and 'csv' express them"
        )
    return motion.caused_by("detector")
