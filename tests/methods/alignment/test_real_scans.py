"""Scans that nobody here made; skipped without the folder of public data.

Frames come in through ``clra import``'s own function, as a user's would.
"""

from itertools import combinations

import numpy as np
import pytest
from scipy import ndimage

import clra
from clra.io.frames.frame_import import import_frames
from clra.methods.assessment.axis_of_arc import axis_offset
from clra.model.grid import default_grid
from clra.ops.streaming.stream import Stream

SHIFT = 6.0  # pixel, either way
# Mean absolute errors allowed [pixel], without what the data cannot see in a parallel beam: a
# constant in v; a constant, a cosine and a sine of the angle in u.
TOLERANCE_U, TOLERANCE_V = 0.05, 0.10


@pytest.fixture(scope="module")
def synchrotron(data, tmp_path_factory):
    """Half a turn of a parallel beam, 91 radiographs of 135 x 160."""
    folder = data / "dls_24737" / "image_test"
    path = tmp_path_factory.mktemp("dls") / "dls.nxs"
    import_frames(
        path,
        str(folder / "tiffs" / "*.tiff"),
        "-88.2:91.8:91",
        parallel=True,
        detector_distance=10.0,
        pixel_size=1.0,
        flats=folder / "flat_00001.tiff",
        darks=folder / "dark_00001.tiff",
        centre_offset=6.25,
    )
    return clra.read_scan(path)


@pytest.mark.parametrize("seed", range(4))
def test_injected_shifts_of_a_real_scan_are_found(synchrotron, seed):
    geometry = synchrotron.geometry
    shift_u, shift_v = np.random.default_rng(seed).uniform(-SHIFT, SHIFT, (2, 91))
    measured = synchrotron.read(0, 91)
    moved = [
        ndimage.shift(image, (v, u), order=3, mode="nearest")
        for image, u, v in zip(measured, shift_u, shift_v, strict=True)
    ]
    found = clra.align(clra.Scan(np.stack(moved), geometry), estimate="shift")
    angle = np.arctan2(geometry.source[:, 0], -geometry.source[:, 1])
    unseen = np.stack([np.ones(91), np.cos(angle), np.sin(angle)], axis=1)
    error_u = found.motion.shift_u - shift_u
    error_u -= unseen @ np.linalg.lstsq(unseen, error_u, rcond=None)[0]
    error_v = found.motion.shift_v - shift_v
    error_v -= error_v.mean()
    assert np.abs(error_u).mean() < TOLERANCE_U
    assert np.abs(error_v).mean() < TOLERANCE_V


@pytest.fixture(scope="module")
def tetrahedron(data, tmp_path_factory):
    """A wire tetrahedron by a foreign simulator: a full turn, both ends included."""
    folder = data / "ctsimu_tetrahedron"
    path = tmp_path_factory.mktemp("tetrahedron") / "tetrahedron.nxs"
    import_frames(
        path,
        folder / "tetra_projections.raw",
        "0:360:21",
        source_distance=300.0,
        detector_distance=100.0,
        pixel_size=1.3,
        shape=(150, 150),
        flats=[folder / f"tetra_flat_{k:04d}.raw" for k in range(3)],
        darks=folder / "tetra_dark.raw",
    )
    return path


def _struts(path):
    """Points along the middles of the six struts, (n, 3), in the scene's coordinates [mm]."""
    record = np.dtype([("normal", "<f4", 3), ("vertices", "<f4", (3, 3)), ("unused", "<u2")])
    vertices = np.fromfile(path, record, offset=84)["vertices"].reshape(-1, 3).astype(float)
    # The four corners are the farthest vertices; struts lie a little inside the edges.
    distance = np.linalg.norm(vertices, axis=1)
    corners = 0.94 * np.unique(np.round(vertices[distance > 0.99 * distance.max()], 3), axis=0)
    assert len(corners) == 4
    along = np.linspace(0.15, 0.85, 40)[:, None]
    lines = [a + along * (b - a) for a, b in combinations(corners, 2)]
    # The scene names the place of the middle of the model's bounding box on the stage.
    middle = (vertices.min(axis=0) + vertices.max(axis=0)) / 2
    return np.concatenate(lines) - middle + [9.428083, 0.0, 8.888888]


def test_struts_are_where_the_model_has_them(data, tetrahedron):
    # The stage's first axis runs along the beam, our y; its third is the rotation axis, our z.
    y, left, z = _struts(data / "ctsimu_tetrahedron" / "tetra.stl").T
    x = -left

    def mean_along_struts(rotation, x, y, z):
        scan = clra.read_scan(tetrahedron, rotation=rotation)
        grid = default_grid(scan.geometry)
        corner = grid.index_to_world()[:3, 3]
        index = [(c - o) / grid.voxel_size for c, o in zip((z, y, x), corner[::-1], strict=True)]
        return ndimage.map_coordinates(clra.reconstruct(scan, grid=grid), index, order=1).mean()

    there = mean_along_struts("ccw", x, y, z)
    # The model is its own mirror image in x; the others tell mirrored and swapped axes.
    for elsewhere in ((x, -y, z), (x, y, -z), (y, x, z)):
        assert mean_along_struts("ccw", *elsewhere) < 0.3 * there
    assert mean_along_struts("cw", x, y, z) < 0.3 * there


def test_the_axis_is_found_by_pairs_and_without_them(synchrotron):
    # By the first and the last views; without the last two no ray is measured twice. Measured: 0.0
    # and 0.25 from where others have it.
    assert abs(axis_offset(Stream(), synchrotron)[0]) < 0.1
    assert abs(axis_offset(Stream(), synchrotron.subset(slice(0, 89)))[0]) < 0.4
