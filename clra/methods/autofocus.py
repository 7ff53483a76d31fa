"""Auto-focus: the column of the axis and the tilt of the panel that make slices sharpest.

Re-projection alignment takes the static geometry for granted: a wrong centre of rotation it can
still shift away, a panel turned in its plane it cannot. A few slices are reconstructed with many
candidates and the sharpest is taken [1]_.

References
----------
.. [1] A. Kingston, A. Sakellariou, T. Varslot, G. Myers, A. Sheppard, "Reliable automatic alignment
   of tomographic projection data by passive auto-focus", Med. Phys. 38, 4934 (2011).
"""

from dataclasses import dataclass, replace
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clra.model.geometry import ConeBeamGeometry
from clra.model.grid import VolumeGrid, default_grid
from clra.model.motion import Motion
from clra.model.panel import with_panel
from clra.model.scan import Scan
from clra.ops.filtering import RampFilter, taper
from clra.ops.projector import BackProjector
from clra.ops.streaming import Radiographs, Report, Stream

Floats = NDArray[np.float64]

# Views that are looked at; most columns in the search and in the refinement; and part of the rows
# over which a view fades out, as for ramp-filtered back-projection.
_VIEWS, _SEARCH_COLUMNS, _COLUMNS, _FADE = 240, 96, 200, 0.1
# The search: offsets up to an eighth of the panel's width either way, and tilts [rad].
_OFFSETS = np.linspace(-0.125, 0.125, 25)
_TILTS = np.radians(np.linspace(-2.0, 2.0, 9))
# Slices, and the part of the field of view's height over which they are spread: a tilt shows far
# from the middle, as an offset that changes with height.
_PLANES, _REACH = 7, 0.8
# Part of the field of view's radius in which sharpness counts, in the search and in the refinement:
# with a large offset its border gets edges of its own, which outdo those of a round sample.
_SEARCH_INSIDE, _INSIDE = 0.7, 0.9
# Rounds of the refinement, each a paraboloid through 3 x 3 candidates, this much closer than the
# last: the last ones are a twentieth of a pixel of the level and 0.01 degrees apart. With three
# rounds 0.2 pixels and, in round samples on a circle, 0.4 degrees are missed.
_ROUNDS, _SHRINK = 5, 0.5


@dataclass(frozen=True)
class Focus:
    """The static geometry that makes slices sharpest.

    Attributes
    ----------
    offset_u : float
        Column of the axis' shadow from where the scan's geometry puts it [pixel of the full panel].
    tilt : float
        Angle by which the panel's image is turned, from columns toward rows [rad].
    sharpening : float
        Mean squared gradient of the slices, relative to that of the scan's own geometry.
    """

    offset_u: float
    tilt: float
    sharpening: float

    def applied(self, scan: Scan) -> Scan:
        """Return the scan with its geometry corrected."""
        geometry = with_panel(scan.geometry, offset_u=self.offset_u, tilt=self.tilt)
        return replace(scan, geometry=geometry)


def autofocus(
    scan: Scan,
    device: Any = None,
    *,
    motion: Motion | None = None,
    progress: Report | None = None,
    max_device_memory: int | None = None,
    max_host_memory: int | None = None,
) -> Focus:
    """Find the column of the axis and the tilt of the panel.

    Parameters
    ----------
    scan : Scan
        Any trajectory of at least a whole turn; it may have moved: blur changes little in where
        slices are sharpest.
    device : str or cl.Device, optional
        As :func:`clra.ops.devices.choose_device` takes it.
    motion : Motion, optional
        Known so far.
    progress : callable, optional
        Called with a :class:`clra.ops.streaming.Progress` as work goes on.
    max_device_memory, max_host_memory : int, optional
        Bytes that may be used.

    Returns
    -------
    Focus
        Offsets up to an eighth of the panel's width are searched, tilts up to 2 degrees.

    Raises
    ------
    ValueError
        If the best lies at the end of what is searched, or slices have no structure.
    """
    stream = Stream(
        device,
        max_device_memory=max_device_memory,
        max_host_memory=max_host_memory,
        report=progress,
    )
    every = max(1, scan.views // _VIEWS)
    scan = scan.subset(slice(0, None, every))
    known = scan.geometry
    if motion is not None:
        known = known.with_motion(motion.subset(slice(0, None, every)))
    total = len(_OFFSETS) + len(_TILTS)
    coarse = _Slices(stream, scan, known, _SEARCH_COLUMNS, _SEARCH_INSIDE)
    offsets = _OFFSETS * scan.geometry.columns

    def searched(candidates: list[tuple[float, float]], done: int) -> int:
        sharpness = []
        for k, (offset, tilt) in enumerate(candidates):
            stream.report("auto-focus: searching", done + k, total)
            sharpness.append(coarse.sharpness(offset, tilt))
        return int(np.argmax(sharpness))

    best = searched([(offset, 0.0) for offset in offsets], 0)
    turned = searched([(offsets[best], tilt) for tilt in _TILTS], len(offsets))
    stream.report("auto-focus: searching", total, total)
    if not coarse.structure:
        raise ValueError(f"{scan.name}: found no structure in any slice, expected a sample")
    if best in (0, len(offsets) - 1):
        raise ValueError(
            f"{scan.name}: found slices still getting sharper at an offset of "
            f"{offsets[best]:.4g} pixels, expected the axis nearer to where the geometry has it"
        )
    fine = _Slices(stream, scan, known, _COLUMNS, _INSIDE)
    return _refined(fine, offsets[best], _TILTS[turned])


def _refined(slices: "_Slices", offset: float, tilt: float) -> Focus:
    """Climb from the best of the search."""
    before = slices.sharpness(0.0, 0.0)
    best = np.array([offset, tilt])
    step = np.array([slices.pixel, np.radians(0.25)])
    grid = np.array(list(product((-1.0, 0.0, 1.0), repeat=2)))
    x, y = grid.T
    design = np.stack([np.ones(9), x, y, x * x, x * y, y * y], axis=1)
    for round_ in range(_ROUNDS):
        slices.stream.report("auto-focus: refining", round_, _ROUNDS)
        values = [np.log(slices.sharpness(*(best + at * step))) for at in grid]
        _, gx, gy, cx, cxy, cy = np.linalg.lstsq(design, np.array(values), rcond=None)[0]
        hessian = np.array([[2 * cx, cxy], [cxy, 2 * cy]])
        highest = grid[int(np.argmax(values))]
        peaked = np.linalg.eigvalsh(hessian).max() < 0
        move = -np.linalg.solve(hessian, [gx, gy]) if peaked else highest
        # A paraboloid is good for no more than where it was fitted, and a little beyond.
        best = best + np.clip(move, -1.5, 1.5) * step
        step *= _SHRINK
    slices.stream.report("auto-focus: refining", _ROUNDS, _ROUNDS)
    return Focus(float(best[0]), float(best[1]), slices.sharpness(*best) / before)


class _Slices:
    """Slices of a scan whose filtered radiographs are kept, for any panel."""

    def __init__(
        self, stream: Stream, scan: Scan, geometry: ConeBeamGeometry, columns: int, inside: float
    ) -> None:
        self.stream, self._geometry = stream, geometry
        # Pixels of the full panel in one of these radiographs.
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
            stream.report("auto-focus: filtering", views.start, scan.views)
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
        """Mean over the slices of their squared gradient, relative to the first call's."""
        geometry = with_panel(self._geometry, offset_u=offset, tilt=tilt).binned(self.pixel)
        self._back.set_geometry(self._squeezed(geometry))
        nz, ny, nx = self._planes.shape
        images = self.stream.empty((ny, nx, nz))
        self._back(self.stream.queue, images, self._filtered).wait()
        slices = self.stream.download(images).astype(np.float64)
        slopes = np.gradient(slices, axis=(0, 1))
        energy = np.mean((slopes[0] ** 2 + slopes[1] ** 2)[self._inside], axis=0)
        if self._first is None:
            self._first = np.where(energy > 0, energy, 1.0)
        return float(np.mean(energy / self._first))

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
