"""Back-projection over pi-intervals against its sum in float64."""

import dataclasses

import numpy as np
import pyopencl.array as cl_array
import pytest
from projector_cases import all_forms

from clra.model.grid import VolumeGrid
from clra.model.helix.helix import Helix
from clra.model.helix.pi_intervals import pi_spans
from clra.ops.projection.pi_backprojector import PiBackProjector

RELATIVE = 1e-4  # of the largest magnitude: positions in float32, on noise
BLEND = 8  # voxels, as in pi_backprojector.cl
RADIUS = 3.3

BASE = Helix(
    views=90,
    start=0.4,
    angle_step=0.09,
    z=-3.4,
    z_step=0.07,
    source_to_axis=12.0,
    source_to_detector=40.0,
    principal=(14.2, 13.9),
    pitch_u=0.9,
    pitch_v=0.8,
    shape=(29, 31),
)
HELICES = {
    "up": BASE,
    "down": dataclasses.replace(BASE, z=3.4, z_step=-0.07, pitch_v=-0.8),
    "back": dataclasses.replace(BASE, angle_step=-0.09, pitch_u=-0.9),
    # rows much finer than voxels
    "fine": dataclasses.replace(BASE, pitch_v=0.05, shape=(470, 31), principal=(14.2, 234.0)),
}
GRID = VolumeGrid(shape=(37, 7, 9), voxel_size=0.31, centre=(0.3, -0.8, 0.4))


def projections_of(helix: Helix) -> np.ndarray:
    shape = (helix.views, *helix.shape)
    return np.random.default_rng(3).uniform(-1, 1, shape).astype(np.float32)


def summed(helix: Helix, projections: np.ndarray, grid: VolumeGrid) -> np.ndarray:
    """Sum over all views, (ny, nx, nz), before it is shared among helices."""
    x, y, z = grid.coordinates()
    y, x, z = np.meshgrid(y, x, z, indexing="ij")
    points = np.stack([x.ravel(), y.ravel(), z.ravel()], axis=1)
    volume = np.zeros(len(points))
    images = np.pad(projections.astype(float), [(0, 0), (30, 30), (0, 1)])
    for view, matrix in enumerate(helix.geometry().projection_matrices()):
        a, b, g = matrix @ np.concatenate([points, np.ones((len(points), 1))], axis=1).T
        column, row = a / g, b / g
        c, r = np.floor(column).astype(int), np.floor(row).astype(int)
        seen = (column >= 0) & (column <= helix.shape[1] - 1)
        chi = np.zeros(len(points))
        ends = [helix.row(np.array(helix.window(helix.tangent_u(n)))) for n in (c, c + 1)]
        f, h = column - c, row - r
        low, high = np.sort(ends[0] * (1 - f) + ends[1] * f, axis=0)
        width = 1 + abs(helix.z_step / (g * helix.pitch_v))
        chi = np.clip((row - low) / width + 0.5, 0, 1) * np.clip((high - row) / width + 0.5, 0, 1)
        seen &= chi > 0
        image, c, r, f, h = images[view], c[seen], r[seen] + 30, f[seen], h[seen]
        value = (1 - h) * ((1 - f) * image[r, c] + f * image[r, c + 1])
        value += h * ((1 - f) * image[r + 1, c] + f * image[r + 1, c + 1])
        volume[seen] += chi[seen] * value / g[seen]
    return volume.reshape(y.shape)


def parts(helix: Helix, grid: VolumeGrid) -> np.ndarray:
    """How much each voxel wants of a helix, (ny, nx, nz)."""
    spans = pi_spans(helix, grid, RADIUS)[:, :, None]
    z = np.arange(grid.shape[0])
    return np.clip(np.minimum(z - spans[..., 0], spans[..., 1] - z) / BLEND, 0, 1)


def back_projected(context, queue, helices, which, projections, grid=GRID):
    operator = PiBackProjector(context, helices, which, grid, RADIUS)
    nz, ny, nx = grid.shape
    volume = cl_array.zeros(queue, (ny, nx, nz), np.float32)
    operator(queue, volume, cl_array.to_device(queue, projections)).wait()
    return volume.get()


@all_forms
@pytest.mark.parametrize("name", HELICES)
def test_back_projection_is_the_sum(context, queue, name, form):
    helix = HELICES[name]
    projections = projections_of(helix)
    found = back_projected(context, queue, [helix], 0, projections)
    expected = summed(helix, projections, GRID) * (parts(helix, GRID) > 0)
    assert (expected != 0).mean() > 0.3
    assert np.abs(found - expected).max() <= RELATIVE * np.abs(expected).max()


def test_helices_share_what_both_hold(context, queue):
    other = dataclasses.replace(BASE, z=BASE.z + 2.0, start=2.0, views=120)
    projections = projections_of(BASE)
    found = back_projected(context, queue, [other, BASE], 1, projections)
    own, others = parts(BASE, GRID), parts(other, GRID)
    share = own / np.maximum(own + others, 1e-9)
    assert share.max() == 1 and np.any((share > 0.1) & (share < 0.9))
    expected = summed(BASE, projections, GRID) * share
    assert np.abs(found - expected).max() <= RELATIVE * np.abs(expected).max()


def test_views_in_parts_slabs_and_any_order_of_the_queue_change_nothing(context, queue, unordered):
    projections = projections_of(BASE)
    whole = back_projected(context, queue, [BASE], 0, projections)
    operator = PiBackProjector(context, [BASE], 0, GRID.slab(11, 30), RADIUS)
    volume = cl_array.zeros(queue, (7, 9, 19), np.float32)
    device = cl_array.to_device(queue, projections)
    queue.finish()
    for start in range(0, 90, 13):
        views = slice(start, min(start + 13, 90))
        operator(unordered, volume, device[views], views=views)
    unordered.finish()
    np.testing.assert_allclose(
        volume.get(), whole[:, :, 11:30], rtol=0, atol=RELATIVE * np.abs(whole).max()
    )


def test_what_is_refused(context, queue):
    operator = PiBackProjector(context, [BASE], 0, GRID, RADIUS)
    volume = cl_array.zeros(queue, (7, 9, 37), np.float32)
    projections = cl_array.zeros(queue, (2, *BASE.shape), np.float32)
    with pytest.raises(ValueError, match="projections: found shape"):
        operator(queue, volume, projections)
    with pytest.raises(TypeError, match="volume_out: found ndarray"):
        operator(queue, volume.get(), projections, views=slice(0, 2))
    with pytest.raises(ValueError, match="views: found"):
        operator(queue, volume, projections, views=slice(90, 92))
