"""Standard errors of a rigid motion, by what held-out views see of them."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from clra.methods.alignment.region import region_of
from clra.methods.alignment.reprojection import used_pixels
from clra.methods.alignment.result import AlignmentResult
from clra.methods.assessment.held_out import HeldOut
from clra.methods.assessment.quality import Quality
from clra.methods.assessment.standard_errors import apart_from_neighbours
from clra.methods.reconstruction.fitted_fbp import fitted_fbp, reprojections
from clra.model.grid import default_grid
from clra.model.motion import Motion
from clra.model.rigid.rigid_motion import RigidMotion
from clra.model.scan import Scan
from clra.ops.streaming.radiographs import Radiographs
from clra.ops.streaming.stream import Stream

Floats = NDArray[np.float64]

# Held-out views of noisy scans lie beside their predictions by at most so many times what those of
# their noiseless re-projections do: 1.4 times in v for balls of 128 pixels with 1e4 photons.
_USUAL = 1.5


def standard_errors(
    stream: Stream, scan: Scan, found: AlignmentResult, judged: AlignmentResult, *, scale: bool
) -> Floats:
    """Return standard errors, (views, 6), enlarged as far as held-out views tell of larger ones.

    Volumes from a half of the views predict the other half to some 0.005 pixel only, more than a
    rigid motion is uncertain by. Re-projections of a volume fit each other exactly: what held-out
    ones of them seem to be displaced by is no error. What those of the scan are displaced by
    beyond that enlarges all standard errors of the registration by one factor.

    Parameters
    ----------
    stream : Stream
        Device and memory budget.
    scan : Scan
        That was aligned, at full resolution.
    found : AlignmentResult
        With the standard errors of the registration.
    judged : AlignmentResult
        The same, judged by held-out views.
    scale : bool
        Whether these were registered with their magnifications.
    """
    quality, motion = judged.quality, found.motion
    assert isinstance(quality, Quality) and isinstance(motion, RigidMotion)
    held_out = HeldOut(stream, scan, default_grid(scan.geometry))
    # Twice as fine: radiographs hold more than the pixels they are compared in.
    factor = max(1, held_out.level // 2)
    views = held_out.chosen(found.valid_views)
    still = _simulated(stream, scan.subset(views), motion.subset(views), factor)
    usual = factor * _apparent(stream, still, scale)
    seen = np.array(quality.shift_after[:2])
    beyond = np.sum(np.maximum(seen**2 - (_USUAL * usual) ** 2, 0.0))
    sigma, valid = found.sigma.copy(), found.valid_views
    formal = np.sum(np.nanmean(sigma[valid, :2] ** 2, axis=0))
    sigma *= np.sqrt(1 + beyond / formal)
    # Rejected views have their neighbours' motion, and differ from it as neighbours do.
    sigma[~valid, :3] = judged.sigma[~valid, :3]
    apart = [apart_from_neighbours(column) for column in motion.rotation.T]
    sigma[~valid, 3:] = np.hypot(sigma[~valid, 3:], apart)
    return sigma


def _simulated(stream: Stream, scan: Scan, motion: RigidMotion, factor: int) -> Scan:
    """Return a scan of re-projections that fit each other, in pixels `factor` times as large."""
    region = region_of(stream, scan, default_grid(scan.geometry))
    geometry = scan.geometry.with_motion(motion).binned(factor)
    stage = "held-out views, simulated"
    volume = fitted_fbp(
        stream,
        Radiographs(stream, scan, factor),
        geometry,
        region.grid.binned(factor) if factor > 1 else region.grid,
        positive=True,
        terms=1,
        used=used_pixels(scan, factor),
        valid_views=np.ones(scan.views, np.bool_),
        circle=not region.truncated,
        stage=stage,
    )
    return Scan(reprojections(stream, volume, geometry, factor, stage), geometry)


def _apparent(stream: Stream, still: Scan, scale: bool) -> Floats:
    """Root mean square of the shifts in u and v that held-out views ask for, gauge-free [pixel]."""
    held_out = HeldOut(stream, still, default_grid(still.geometry))
    radiographs, views = held_out.radiographs(np.ones(still.views, np.bool_))
    predicted = held_out.predict(
        radiographs,
        views,
        Motion.identity(still.views),
        magnification=scale,
        whole=True,
        stage="held-out views, simulated",
    )
    left = predicted.left(still.geometry, magnification=scale)
    return np.asarray(np.sqrt(np.nanmean(left[:, :2] ** 2, axis=0)))


def with_standard_errors(
    stream: Stream, scan: Scan, found: AlignmentResult, judged: AlignmentResult, *, scale: bool
) -> AlignmentResult:
    """Return a judged alignment with the standard errors of its rigid motion, if it has one."""
    if not isinstance(judged.motion, RigidMotion):
        return judged
    return replace(judged, sigma=standard_errors(stream, scan, found, judged, scale=scale))
