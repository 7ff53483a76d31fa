"""A source that drifts, in the geometry of the paper's scan of wood."""

import numpy as np
import pytest

import clra
from clra.model.gauge.gauge import sample_points, without_gauge
from clra.model.grid import default_grid
from clra.model.phantoms.ellipsoids import porous
from clra.model.phantoms.perturbation import smooth_motion

# Fan 67 degrees: half of a lateral shift differs across the depth of the sample.
VIEWS, SHAPE = 120, (96, 96)
WOOD = {"source_to_axis": 2.8823, "source_to_detector": 315.5, "pixel_size": 422.56 / 96}
HEIGHT = 48 * 422.56 / 96 * 2.8823 / 315.5


@pytest.fixture(scope="module")
def drifting():
    geometry = clra.space_filling(VIEWS, z_step=HEIGHT / VIEWS, shape=SHAPE, **WOOD)
    grid = default_grid(geometry)
    drift = smooth_motion(VIEWS, seed=2, shift=(-4, 4), magnification=0.004)
    truth = without_gauge(drift, geometry, [sample_points(grid)]).caused_by("source")
    sample = porous(0.45 * grid.shape[1] * grid.voxel_size, 2.2 * HEIGHT, 3)
    radiographs = sample.line_integrals(geometry.with_motion(truth))
    return clra.Scan(radiographs, geometry, truth=truth)


def _left(scan, motion, estimate):
    """Residual of the re-projection at full resolution with a motion."""
    found = clra.align(scan, schedule="1FR", estimate=estimate, motion=motion, quality=False)
    return found.history[0].residual


def test_parallax_is_explained(drifting):
    found = {
        estimate: clra.align(drifting, schedule="3QR-2HR", estimate=estimate, quality=False)
        for estimate in ("shift+scale", "source")
    }
    assert found["source"].motion.cause == "source"
    least = _left(drifting, drifting.truth, "source")
    excess = {name: _left(drifting, r.motion, name) - least for name, r in found.items()}
    assert excess["source"] < 0.5 * excess["shift+scale"]
    assert excess["source"] < 0.01 * least
    for name in ("gauge_free_u", "gauge_free_v"):
        error = {key: getattr(r.history[-1], name) for key, r in found.items()}
        assert error["source"] < error["shift+scale"]


def test_the_volume_is_made_with_the_source_where_it_was(drifting):
    grid = default_grid(drifting.geometry)
    geometry = drifting.geometry.with_motion(drifting.truth)
    known = clra.reconstruct(clra.Scan(drifting.projections, geometry), grid=grid)
    moved = clra.reconstruct(drifting, grid=grid, motion=drifting.truth)
    assert np.array_equal(known, moved)
