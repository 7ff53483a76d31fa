"""Auto-focus: the column of the axis and the tilt of the detector that make slices sharpest.

Re-projection alignment takes the static geometry for granted: a wrong centre of rotation it can
still shift away, a detector turned in its plane it cannot. A few slices are reconstructed with many
candidates and the sharpest is taken [1]_. Where the radiographs jitter, what is sharpest is off by
some tenths of a pixel and of a degree: a short alignment at a low resolution finds most of the
jitter, and with it known the slices are made as sharp as they can be.

References
----------
.. [1] A. Kingston, A. Sakellariou, T. Varslot, G. Myers, A. Sheppard, "Reliable automatic alignment
   of tomographic projection data by passive auto-focus", Med. Phys. 38, 4934 (2011).
"""

import math
import warnings
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clra.errors import InputError
from clra.methods.alignment.align import align
from clra.methods.assessment.axis_of_arc import axis_offset
from clra.methods.assessment.slice_sharpness import VIEWS, Slices
from clra.model.detector_pose import with_detector
from clra.model.sampling.angular_coverage import covered, is_circle
from clra.model.scan import Scan
from clra.model.schedule import level_name
from clra.ops.registration.gauss_newton import SMALLEST
from clra.ops.streaming.stream import Stream
from clra.progress import ProgressCallback

Floats = NDArray[np.float64]

# Most columns in the search.
_SEARCH_COLUMNS = 96
# The search: offsets up to an eighth of the detector's width either way, and tilts [rad].
_OFFSETS = np.linspace(-0.125, 0.125, 25)
_TILTS = np.radians(np.linspace(-2.0, 2.0, 9))
# Part of the field of view's radius in which sharpness counts in the search: with a large offset
# its border gets edges of its own, which outdo those of a round sample.
_SEARCH_INSIDE = 0.7
# Iterations of the short alignment.
_ITERATIONS = 2
# Rounds of the refinement: offset and tilt in turn, by parabolas through points first this far
# apart [pixel of the level, rad] and in each round closer.
_ROUNDS, _STEPS, _SHRINK = 4, (0.5, np.radians(0.5)), 0.5


@dataclass(frozen=True)
class Focus:
    """The static geometry that makes slices sharpest.

    Attributes
    ----------
    offset_u : float
        Column of the axis' projection from where the scan's geometry puts it [pixel of the full
        detector].
    tilt : float
        Angle by which the detector's image is turned, from columns toward rows [rad].
    sharpening : float
        Mean squared gradient of the slices, relative to that of the scan's own geometry; of an arc
        how much better the rays of a line agree, in squares.
    """

    offset_u: float
    tilt: float
    sharpening: float

    def applied(self, scan: Scan) -> Scan:
        """Return the scan with its geometry corrected."""
        geometry = with_detector(scan.geometry, offset_u=self.offset_u, tilt=self.tilt)
        return replace(scan, geometry=geometry)


def autofocus(
    scan: Scan,
    device: Any = None,
    *,
    progress: ProgressCallback | None = None,
    max_device_memory: int | None = None,
    max_host_memory: int | None = None,
) -> Focus:
    """Find the column of the axis and the tilt of the detector.

    Parameters
    ----------
    scan : Scan
        Any trajectory; it may have moved. Of an arc the axis alone is found, by the rays that are
        measured twice (:func:`clra.methods.assessment.axis_of_arc.axis_offset`).
    device : str or cl.Device, optional
        As :func:`clra.ops.runtime.devices.choose_device` takes it.
    progress : callable, optional
        Called with a :class:`clra.progress.Progress` as work goes on.
    max_device_memory, max_host_memory : int, optional
        Bytes that may be used.

    Returns
    -------
    Focus
        Offsets up to an eighth of the detector's width are searched, tilts up to 2 degrees.

    Raises
    ------
    InputError
        If the best lies at the end of what is searched, slices have no structure, or hardly a ray
        of an arc is measured twice.
    """
    limits: dict[str, Any] = {
        "max_device_memory": max_device_memory,
        "max_host_memory": max_host_memory,
    }
    stream = Stream(device, report=progress, **limits)
    if is_circle(scan.geometry) and covered(scan.geometry) < 2 * math.pi:
        # Slices of half a turn are sharpest with a detector tilted by 3 degrees too much.
        offset, gain = axis_offset(stream, scan)
        return Focus(offset, 0.0, gain)
    every = max(1, scan.views // VIEWS)
    scan = scan.subset(slice(0, None, every))
    coarse = Slices(stream, scan, scan.geometry, _SEARCH_COLUMNS, _SEARCH_INSIDE)
    rough = _searched(coarse, scan)
    focused = replace(scan, geometry=with_detector(scan.geometry, offset_u=rough[0], tilt=rough[1]))
    schedule = f"{_ITERATIONS}{level_name(_level(scan, coarse.pixel))}"
    del coarse  # its memory is the alignment's
    with warnings.catch_warnings():
        # Of these few views and pixels; the alignment proper judges for itself.
        warnings.simplefilter("ignore")
        found = align(
            focused,
            schedule=schedule,
            estimate="shift",
            device=stream.device,
            progress=progress,
            **limits,
        )
    fine = Slices(stream, scan, focused.geometry.with_motion(found.motion))
    more = _climbed(fine)
    return Focus(
        # Slices are sharp with the axis in one place; motions are about its mean.
        offset_u=rough[0] + more[0] + float(found.motion.shift_u.mean()),
        tilt=rough[1] + more[1],
        sharpening=fine.sharpness(*more) / fine.sharpness(-rough[0], -rough[1]),
    )


def _searched(slices: Slices, scan: Scan) -> tuple[float, float]:
    """Return the offset and then the tilt of sharpest slices, from far and wide."""
    offsets = _OFFSETS * scan.geometry.columns
    total = len(offsets) + len(_TILTS)

    def sharpest(candidates: list[tuple[float, float]], done: int) -> int:
        sharpness = []
        for k, (offset, tilt) in enumerate(candidates):
            slices.stream.report("auto-focus: searching", done + k, total)
            sharpness.append(slices.sharpness(offset, tilt))
        return int(np.argmax(sharpness))

    best = sharpest([(offset, 0.0) for offset in offsets], 0)
    turned = sharpest([(offsets[best], tilt) for tilt in _TILTS], len(offsets))
    slices.stream.report("auto-focus: searching", total, total)
    if not slices.structure:
        raise InputError(f"{scan.name}: found no structure in any slice, expected a sample")
    if best in (0, len(offsets) - 1):
        raise InputError(
            f"{scan.name}: found slices still getting sharper at an offset of "
            f"{offsets[best]:.4g} pixels, expected the axis nearer to where the geometry has it"
        )
    return float(offsets[best]), float(_TILTS[turned])


def _level(scan: Scan, level: int) -> int:
    """Return the level, or a finer one if it leaves too few rows or columns."""
    while level > 1 and min(scan.geometry.shape) // level < SMALLEST:
        level //= 2
    return level


def _climbed(slices: Slices) -> tuple[float, float]:
    """Climb from offset and tilt 0 to sharpest slices."""
    best = np.zeros(2)
    steps = np.diag([_STEPS[0] * slices.pixel, _STEPS[1]])
    for round_ in range(_ROUNDS):
        slices.stream.report("auto-focus: refining", round_, _ROUNDS)
        for step in steps:
            lower, here, higher = (np.log(slices.sharpness(*(best + k * step))) for k in (-1, 0, 1))
            slope, bend = 0.5 * (higher - lower), higher - 2 * here + lower
            move = -slope / bend if bend < 0 else np.sign(slope)
            # A parabola is good for no more than where it was fitted, and a little beyond.
            best = best + np.clip(move, -1.5, 1.5) * step
        steps = steps * _SHRINK
    slices.stream.report("auto-focus: refining", _ROUNDS, _ROUNDS)
    return float(best[0]), float(best[1])
