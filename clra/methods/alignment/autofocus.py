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
from clra.model.detector_pose import with_detector
from clra.model.geometry import ConeBeamGeometry
from clra.model.grid import VolumeGrid, default_grid
from clra.model.motion import Motion
from clra.model.rotation_sense import opposite_rotation
from clra.model.sampling.angular_coverage import covered
from clra.model.scan import Scan
from clra.model.schedule import level_name
from clra.ops.filtering.ramp import RampFilter, taper
from clra.ops.projection.projector import BackProjector
from clra.ops.registration.gauss_newton import SMALLEST
from clra.ops.streaming.memory import DeviceMemoryError
from clra.ops.streaming.radiographs import Radiographs
from clra.ops.streaming.stream import Stream
from clra.progress import ProgressCallback

Floats = NDArray[np.float64]

# Views that are looked at; most columns in the search and in the refinement; and part of the rows
# over which a view fades out, as for ramp-filtered back-projection.
_VIEWS, _SEARCH_COLUMNS, _COLUMNS, _FADE = 240, 96, 200, 0.1
# The search: offsets up to an eighth of the detector's width either way, and tilts [rad].
_OFFSETS = np.linspace(-0.125, 0.125, 25)
_TILTS = np.radians(np.linspace(-2.0, 2.0, 9))
# Slices, and the part of the field of view's height over which they are spread: a tilt shows far
# from the middle, as an offset that changes with height.
_PLANES, _REACH = 7, 0.8
# Part of the field of view's radius in which sharpness counts, in the search and in the refinement:
# with a large offset its border gets edges of its own, which outdo those of a round sample.
_SEARCH_INSIDE, _INSIDE = 0.7, 0.9
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
        Mean squared gradient of the slices, relative to that of the scan's own geometry.
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
        Any trajectory of at least a whole turn; it may have moved.
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
        If views cover less than a turn, the best lies at the end of what is searched, or slices
        have no structure.
    """
    angle = covered(scan.geometry)
    if angle < 2 * math.pi:
        # Slices of half a turn are sharpest with a detector tilted by 3 degrees too much.
        raise InputError(
            f"{scan.name}: found views over {math.degrees(angle):.0f} degrees, expected a whole "
            "turn to find the axis and the detector's tilt by"
        )
    limits: dict[str, Any] = {
        "max_device_memory": max_device_memory,
        "max_host_memory": max_host_memory,
    }
    stream = Stream(device, report=progress, **limits)
    every = max(1, scan.views // _VIEWS)
    scan = scan.subset(slice(0, None, every))
    coarse = _Slices(stream, scan, scan.geometry, _SEARCH_COLUMNS, _SEARCH_INSIDE)
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
    fine = _Slices(stream, scan, focused.geometry.with_motion(found.motion), _COLUMNS, _INSIDE)
    more = _climbed(fine)
    return Focus(
        # Slices are sharp with the axis in one place; motions are about its mean.
        offset_u=rough[0] + more[0] + float(found.motion.shift_u.mean()),
        tilt=rough[1] + more[1],
        sharpening=fine.sharpness(*more) / fine.sharpness(-rough[0], -rough[1]),
    )


def sharpening_by_turning_back(
    scan: Scan,
    motion: Motion,
    device: Any = None,
    *,
    progress: ProgressCallback | None = None,
    max_device_memory: int | None = None,
    max_host_memory: int | None = None,
) -> float:
    """How much sharper slices would be if the sample turned the other way.

    Radiographs of a narrow beam fit a wrong sense nearly as well as the right one, by a mirrored
    volume that is sharp near the axis and smeared far from it.

    Parameters
    ----------
    scan : Scan
        Any.
    motion : Motion
        Of its views, as far as known.
    device : str or cl.Device, optional
        As :func:`clra.ops.runtime.devices.choose_device` takes it.
    progress : callable, optional
        Called with a :class:`clra.progress.Progress` as work goes on.
    max_device_memory, max_host_memory : int, optional
        Bytes that may be used.

    Returns
    -------
    float
        Mean squared gradient of a slice, relative to that of the scan's own sense, median over a
        few of them: what a circle sees at the ends of its height is sharp by artefacts. 1 where the
        senses cannot be told apart, as in a parallel beam; less where the own one is right; nan if
        a few slices want more memory than there may be.
    """
    stream = Stream(
        device,
        report=progress,
        max_device_memory=max_device_memory,
        max_host_memory=max_host_memory,
    )
    chosen = slice(0, None, max(1, scan.views // _VIEWS))
    scan, motion = scan.subset(chosen), motion.subset(chosen)
    ours, other = (g.with_motion(motion) for g in (scan.geometry, opposite_rotation(scan.geometry)))
    try:
        slices = _Slices(stream, scan, ours, _COLUMNS, _INSIDE)
        slices.sharpnesses(ours)
        return float(np.median(slices.sharpnesses(other)))
    except DeviceMemoryError:
        return float("nan")


def _searched(slices: "_Slices", scan: Scan) -> tuple[float, float]:
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


def _climbed(slices: "_Slices") -> tuple[float, float]:
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


class _Slices:
    """Slices of a scan whose filtered radiographs are kept, for any detector."""

    def __init__(
        self, stream: Stream, scan: Scan, geometry: ConeBeamGeometry, columns: int, inside: float
    ) -> None:
        self.stream, self._geometry = stream, geometry
        # Pixels of the full detector in one of these radiographs.
        self.pixel = next((n for n in (1, 2, 4) if geometry.columns // n <= columns), 8)
        radiographs = Radiographs(stream, scan, self.pixel)
        binned = geometry.binned(self.pixel)
        self._filtered = stream.empty(radiographs.shape)
        ramp = RampFilter(
            stream.context,
            binned,
            row_weight=taper(binned.rows, _FADE),
            allocator=stream.memory,
            scratch_limit=stream.scratch_limit,
        )
        for views in stream.chunks(scan.views, radiographs.view_bytes):
            stream.report("slices: filtering", views.start, scan.views)
            measured = stream.upload(radiographs.read(views))
            ramp(stream.queue, self._filtered[views], measured, views=views).wait()
        grid = default_grid(scan.geometry).binned(self.pixel)
        nz, ny, nx = grid.shape
        apart = _REACH * nz / (_PLANES - 1)
        # Planes far apart are neighbours in a world that is squeezed along z.
        self._squeeze = (grid.centre[2], max(apart, 1.0))
        x0, y0, _ = grid.centre
        self._planes = VolumeGrid(
            shape=(_PLANES, ny, nx), voxel_size=grid.voxel_size, centre=(x0, y0, 0.0)
        )
        self._back = BackProjector(
            stream.context, self._squeezed(binned), self._planes, volume_order="yxz"
        )
        y, x = np.ogrid[:ny, :nx]
        radius = 0.5 * inside * min(nx, ny)
        self._inside = np.hypot(y - (ny - 1) / 2, x - (nx - 1) / 2) < radius
        self._first: Floats | None = None

    def sharpness(self, offset: float, tilt: float) -> float:
        """Mean over the slices of their sharpness with the detector elsewhere."""
        moved = with_detector(self._geometry, offset_u=offset, tilt=tilt)
        return float(np.mean(self.sharpnesses(moved)))

    def sharpnesses(self, geometry: ConeBeamGeometry) -> Floats:
        """Return the mean squared gradient of each slice, relative to the first call's."""
        self._back.set_geometry(self._squeezed(geometry.binned(self.pixel)))
        nz, ny, nx = self._planes.shape
        images = self.stream.empty((ny, nx, nz))
        self._back(self.stream.queue, images, self._filtered).wait()
        slices = self.stream.download(images).astype(np.float64)
        slopes = np.gradient(slices, axis=(0, 1))
        energy = np.mean((slopes[0] ** 2 + slopes[1] ** 2)[self._inside], axis=0)
        if self._first is None:
            self._first = np.where(energy > 0, energy, 1.0)
        return np.asarray(energy / self._first)

    @property
    def structure(self) -> bool:
        """Whether any slice was more than constant."""
        return self._first is not None and bool(np.any(self._first != 1.0))

    def _squeezed(self, geometry: ConeBeamGeometry) -> ConeBeamGeometry:
        """Return the geometry in a world whose heights are divided; pixels see the same."""
        middle, factor = self._squeeze
        vectors = geometry.to_astra().reshape(-1, 4, 3)
        vectors[:, :2, 2] -= middle
        vectors[:, :, 2] /= factor
        return ConeBeamGeometry.from_astra(vectors.reshape(-1, 12), geometry.shape)
