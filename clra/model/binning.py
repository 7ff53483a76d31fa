"""Scans whose radiographs are averaged over blocks of pixels as they are read."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clra.model.corrections.corrections import Corrections
from clra.model.motion import Motion
from clra.model.rigid.rigid_motion import RigidMotion
from clra.model.scan import Scan


def binned_scan(scan: Scan, factor: int) -> Scan:
    """Return a scan of line integrals averaged over `factor` x `factor` pixels.

    Parameters
    ----------
    scan : Scan
        Corrected as it is read; nothing is read now.
    factor : int
        Rows and columns of a block; those that fill no whole block are dropped.

    Returns
    -------
    Scan
        The scan itself if `factor` is 1. Motions are in its pixels, see :func:`binned_motion`.

    Raises
    ------
    InputError
        If `factor` is less than 1 or more than the detector has.
    """
    geometry = scan.geometry.binned(factor)
    if factor == 1:
        return scan
    truth = scan.truth
    return replace(
        scan,
        projections=_Binned(scan, factor),
        geometry=geometry,
        kind="line-integrals",
        truth=None if truth is None else binned_motion(truth, factor, scan.geometry.shape),
        mask=None,
        # Those of the scan are made already.
        corrections=Corrections(),
    )


def binned_motion(motion: Motion, factor: int, shape: tuple[int, int]) -> Motion:
    """Return a motion in pixels of a binned detector, with magnifications about its middle.

    Parameters
    ----------
    motion : Motion
        In pixels of the whole detector.
    factor : int
        Binning.
    shape : (int, int)
        Rows and columns of the whole detector.
    """
    rows, columns = shape
    moved = motion.about(-0.5 * (columns % factor), -0.5 * (rows % factor))
    if isinstance(moved, RigidMotion):  # in lengths: only the pixels it is seen in are others
        optics = moved.optics / np.array([1, factor, factor, factor, factor])
        return RigidMotion(translation=moved.translation, rotation=moved.rotation, optics=optics)
    return Motion(
        shift_u=moved.shift_u / factor,
        shift_v=moved.shift_v / factor,
        magnification=moved.magnification,
        cause=moved.cause,
    )


class _Binned:
    """Line integrals of a scan, averaged view by view so that one at a time is whole in memory."""

    def __init__(self, scan: Scan, factor: int) -> None:
        self._scan, self._factor = scan, factor
        self.shape = (scan.views, *(n // factor for n in scan.geometry.shape))

    def __getitem__(self, index: slice) -> NDArray[Any]:
        start, stop, _ = index.indices(self.shape[0])
        _, rows, columns = self.shape
        k = self._factor
        binned = np.empty((max(0, stop - start), rows, columns), np.float32)
        for place, view in enumerate(range(start, stop)):
            image = self._scan.read(view, view + 1)[0, : rows * k, : columns * k]
            binned[place] = image.reshape(rows, k, columns, k).mean(axis=(1, 3))
        return binned
