"""Simulated scans: closed-form radiographs of a phantom that moves in a known way."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clra.errors import InputError
from clra.model import trajectory
from clra.model.gauge.gauge import sample_points, without_gauge
from clra.model.geometry import ConeBeamGeometry
from clra.model.grid import VolumeGrid, default_grid
from clra.model.motion import Motion
from clra.model.phantoms.ellipsoids import Ellipsoids, porous, three_spheres
from clra.model.phantoms.perturbation import random_motion, smooth_motion
from clra.model.phantoms.wood import wood
from clra.model.scan import Scan

TRAJECTORIES = ("circular", "helix", "double-helix", "space-filling")
MOTIONS = ("none", "random", "smooth", "both")
PHANTOMS = ("spheres", "porous", "wood")

# The paper's simulation: 3456 views of (we take) 928 rows, 0.5 degree apart on the helix, travel
# 5.671 mm. A smaller scan keeps the fan, the turns and the travel in heights of the detector.
_PAPER_VIEWS, _PAPER_HELIX_STEP = 3456, math.radians(0.5)
# Radius of the sample as a part of the field of view's: shifted by 4 % of the detector's width it
# is still not truncated.
_FILLED = 0.9
# Seeds of the clouds of points whose gauge is taken out of a truth.
_CLOUDS = (0, 1, 2)


def paper_like(kind: str, views: int, shape: tuple[int, int]) -> ConeBeamGeometry:
    """Return the paper's geometry scaled to a detector of another size.

    Fan angle and distances stay; the pixel grows as the columns get fewer. The travel along z
    stays the same part of the detector's height, and the helix keeps its 4.8 turns.

    Parameters
    ----------
    kind : {"circular", "helix", "double-helix", "space-filling"}
        Trajectory.
    views : int
        Number of radiographs; even for a double helix.
    shape : (int, int)
        Rows and columns of the detector.

    Raises
    ------
    InputError
        If the kind is unknown or the number of views does not suit it.
    """
    paper = trajectory.PAPER
    rows, columns = shape
    pixel = paper["pixel_size"] * paper["shape"][1] / columns
    height = rows * pixel / (paper["shape"][0] * paper["pixel_size"])
    common: dict[str, Any] = {
        "source_to_axis": paper["source_to_axis"],
        "source_to_detector": paper["source_to_detector"],
        "pixel_size": pixel,
        "shape": shape,
    }
    if kind == "circular":
        return trajectory.circular(views, **common)
    if kind not in TRAJECTORIES:
        raise InputError(f"trajectory: found {kind!r}, expected one of {', '.join(TRAJECTORIES)}")
    if kind == "double-helix" and views % 2:
        raise InputError(f"views: found {views}, expected an even number for a double helix")
    along = views // 2 if kind == "double-helix" else views
    fewer = _PAPER_VIEWS / along
    common["z_step"] = paper["z_step"] * height * fewer
    if kind == "space-filling":
        return trajectory.space_filling(views, **common)
    common["angle_step"] = _PAPER_HELIX_STEP * fewer
    if kind == "helix":
        return trajectory.helix(views, **common)
    return trajectory.double_helix(along, **common)


def sample(kind: str, geometry: ConeBeamGeometry, seed: int = 0) -> Ellipsoids:
    """Return a phantom that fills the field of view without being truncated at its sides.

    Parameters
    ----------
    kind : {"spheres", "porous", "wood"}
        The paper's stack of three spheres, many small spheres, or hollow fibres along the axis.
    geometry : ConeBeamGeometry
        What looks at it.
    seed : int
        Of the random positions.

    Raises
    ------
    InputError
        If the kind is unknown.
    """
    if kind not in PHANTOMS:
        raise InputError(f"phantom: found {kind!r}, expected one of {', '.join(PHANTOMS)}")
    cylinder = _cylinder(geometry)
    nz, _, nx = cylinder.shape
    radius, height = 0.5 * nx * cylinder.voxel_size, nz * cylinder.voxel_size
    if kind == "spheres":
        return three_spheres(radius, height)
    return porous(radius, height, seed) if kind == "porous" else wood(radius, height, seed)


def _cylinder(geometry: ConeBeamGeometry) -> VolumeGrid:
    """Grid that just holds the sample."""
    whole = default_grid(geometry)
    nz, _, nx = whole.shape
    across = round(_FILLED * nx)
    if np.ptp(geometry.source[:, 2]) == 0:
        # No view looks past the end of a sample on a circle: the near side has to fit the detector.
        radius = 0.5 * across * whole.voxel_size
        nz = int(_FILLED * nz * (1 - radius / float(np.min(geometry.source_to_axis))))
    return VolumeGrid(shape=(max(nz, 1), across, across), voxel_size=whole.voxel_size)


def simulated_motion(
    kind: str,
    geometry: ConeBeamGeometry,
    *,
    shift: tuple[float, float],
    magnification: float = 0.0,
    seed: int = 0,
    keep_gauge: bool = False,
) -> Motion:
    """Return a motion of every view.

    Parameters
    ----------
    kind : {"none", "random", "smooth", "both"}
        Jitter, drift, or the sum of the two, each over half the range.
    geometry : ConeBeamGeometry
        Of the scan.
    shift : (float, float)
        Least and greatest shift [pixel].
    magnification : float
        Magnifications lie within 1 -+ this.
    seed : int
        Of the random numbers.
    keep_gauge : bool
        Leave in what a movement of the sample as a whole would explain. No estimate can be expected
        to find that part, so that errors have a floor.

    Raises
    ------
    InputError
        If the kind is unknown or a range is wrong.
    """
    if kind not in MOTIONS:
        raise InputError(f"motion: found {kind!r}, expected one of {', '.join(MOTIONS)}")
    if kind == "none":
        return Motion.identity(geometry.views)
    part = 0.5 if kind == "both" else 1.0
    ranges: dict[str, Any] = {
        "shift": (part * shift[0], part * shift[1]),
        "magnification": part * magnification,
    }
    motion = Motion.identity(geometry.views)
    if kind in ("random", "both"):
        motion = motion.then(random_motion(geometry.views, seed=seed, **ranges))
    if kind in ("smooth", "both"):
        motion = motion.then(smooth_motion(geometry.views, seed=seed + 1, **ranges))
    if keep_gauge:
        return motion
    grid = _cylinder(geometry)
    clouds = [sample_points(grid, seed=cloud) for cloud in _CLOUDS]
    return without_gauge(motion, geometry, clouds, magnification=magnification > 0)


def simulated_scan(
    geometry: ConeBeamGeometry,
    phantom: Ellipsoids,
    motion: Motion,
    *,
    noise: float | None = None,
    seed: int = 0,
    name: str = "simulation",
) -> Scan:
    """Return a scan whose radiographs are computed when they are read.

    Parameters
    ----------
    geometry : ConeBeamGeometry
        That everybody believes in.
    phantom : Ellipsoids
        The sample.
    motion : Motion
        What really happened; kept as the scan's truth.
    noise : float, optional
        Photons a pixel of the open beam; without it there is no noise.
    seed : int
        Of the noise. A view's noise does not depend on how the views are read.
    name : str
        The scan's.

    Raises
    ------
    InputError
        If `noise` is not positive.
    """
    if noise is not None and not (math.isfinite(noise) and noise > 0):
        raise InputError(f"noise: found {noise:g} photons a pixel, expected more than 0")
    radiographs = _Simulated(geometry.with_motion(motion), phantom, noise, seed)
    return Scan(radiographs, geometry, name=name, truth=motion)


def counted(
    image: NDArray[np.float32], photons: float, *, seed: tuple[int, int]
) -> NDArray[np.float32]:
    """Return line integrals as they are measured by counting photons.

    Parameters
    ----------
    image : ndarray, (rows, columns)
        Line integrals.
    photons : float
        Expected in a pixel of the open beam.
    seed : (int, int)
        Of the random numbers: of the scan, and the view.
    """
    random = np.random.default_rng(seed)
    counts = random.poisson(photons * np.exp(-image.astype(np.float64)))
    # A pixel that no photon reached is taken for half of one, as its logarithm must be.
    return np.log(photons / np.maximum(counts, 0.5)).astype(np.float32)


@dataclass(frozen=True)
class _Simulated:
    """Line integrals (views, rows, columns), computed as they are sliced."""

    geometry: ConeBeamGeometry
    phantom: Ellipsoids
    noise: float | None
    seed: int

    @property
    def shape(self) -> tuple[int, ...]:
        return (self.geometry.views, *self.geometry.shape)

    def __getitem__(self, views: slice) -> NDArray[np.float32]:
        start, stop, _ = views.indices(self.geometry.views)
        images = self.phantom.line_integrals(self.geometry, start, stop)
        if self.noise is not None:
            for view, image in enumerate(images, start):
                image[...] = counted(image, self.noise, seed=(self.seed, view))
        return images
