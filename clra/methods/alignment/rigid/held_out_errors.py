"""Standard errors of a rigid motion, by what held-out views see of them."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from clra.methods.alignment.region import region_of
from clra.methods.alignment.result import AlignmentResult
from clra.methods.assessment.held_out import HeldOut, Predicted
from clra.methods.assessment.quality import Quality
from clra.methods.reconstruction.fitted_fbp import fitted_fbp, reprojections
from clra.model.gauge.gauge import Gauge, sample_points
from clra.model.grid import default_grid
from clra.model.motion import Motion
from clra.model.rigid.rigid_motion import RigidMotion
from clra.model.scan import Scan
from clra.ops.streaming.stream import Stream

Floats = NDArray[np.float64]

# Held-out views of noisy scans lie beside their predictions by at most so many times what those of
# their noiseless re-projections do: 1.4 times in v for balls of 128 pixels with 1e4 photons.
_USUAL = 1.5
# Points of the sample by which the gauge is known.
_POINTS = 300


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
    region = region_of(stream, scan, default_grid(scan.geometry))
    held_out = HeldOut(stream, scan, region.grid)
    level = held_out.level
    radiographs, views = held_out.radiographs(found.valid_views)
    geometry = scan.geometry.subset(views).with_motion(motion.subset(views)).binned(level)
    stage = "held-out views, simulated"
    volume = fitted_fbp(
        stream,
        radiographs,
        geometry,
        region.grid.binned(level) if level > 1 else region.grid,
        positive=True,
        terms=1,
        used=np.ones(geometry.shape, np.bool_),
        valid_views=np.ones(len(views), np.bool_),
        circle=not region.truncated,
        stage=stage,
    )
    still = reprojections(stream, volume, geometry, level, stage)
    del volume
    usual = _apparent(
        scan,
        held_out.predict(still, views, motion, magnification=scale, whole=True, stage=stage),
        scale,
    )
    seen = np.array(quality.shift_after[:2])
    beyond = np.sum(np.maximum(seen**2 - (_USUAL * usual) ** 2, 0.0))
    sigma, valid = found.sigma.copy(), found.valid_views
    formal = np.sum(np.nanmean(sigma[valid, :2] ** 2, axis=0))
    sigma *= np.sqrt(1 + beyond / formal)
    # Rejected views have their neighbours' motion, and differ from it as neighbours do.
    apart = motion.rotation[1:-1] - 0.5 * (motion.rotation[2:] + motion.rotation[:-2])
    sigma[~valid, :3] = judged.sigma[~valid, :3]
    sigma[~valid, 3:] = np.hypot(sigma[~valid, 3:], np.sqrt(np.mean(apart**2, axis=0)))
    return sigma


def _apparent(scan: Scan, predicted: Predicted, scale: bool) -> Floats:
    """Root mean square of the shifts in u and v that held-out views ask for, gauge-free [pixel]."""
    views = np.flatnonzero(np.isfinite(predicted.residual))
    u, v, m = predicted.shift[views].T
    points = sample_points(default_grid(scan.geometry), _POINTS)
    gauge = Gauge(scan.geometry.subset(views), points, magnification=scale)
    left = gauge.fit(Motion(shift_u=u, shift_v=v, magnification=np.exp(m))).remainder
    return np.asarray(np.sqrt(np.mean(left[:, :2] ** 2, axis=0)))


def with_standard_errors(
    stream: Stream, scan: Scan, found: AlignmentResult, judged: AlignmentResult, *, scale: bool
) -> AlignmentResult:
    """Return a judged alignment with the standard errors of its rigid motion, if it has one."""
    if not isinstance(judged.motion, RigidMotion):
        return judged
    return replace(judged, sigma=standard_errors(stream, scan, found, judged, scale=scale))
