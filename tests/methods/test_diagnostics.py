"""Geometries that contradict the data, named."""

import numpy as np
import pytest

import clra
from clra.app.simulation import sample, simulated_scan
from clra.methods.diagnostics import contradicted_geometry, doubted_rotation, large_motion
from clra.ops.streaming.stream import Stream

VIEWS, SHAPE = 72, (48, 64)
CONE = {
    "source_to_axis": 4.0,
    "source_to_detector": 20.0,
    "pixel_size": 0.15,
    "shape": SHAPE,
}


@pytest.fixture(scope="module")
def frames():
    """Radiographs of a helix whose sample moved by up to 2 pixels."""
    geometry = helix()
    u, v = np.random.default_rng(1).uniform(-2, 2, (2, VIEWS))
    phantom = sample("porous", geometry, 1)
    moved = simulated_scan(geometry, phantom, clra.Motion(shift_u=u, shift_v=v), noise=1e4)
    return moved.read(0, VIEWS)


def helix(angle_step=4 * np.pi / VIEWS, **words):
    return clra.helix(VIEWS, angle_step=angle_step, z_step=0.015, **CONE, **words)


def named(frames, geometry):
    found = contradicted_geometry(Stream(), clra.Scan(np.ascontiguousarray(frames), geometry))
    return None if found is None else found.code


def test_the_right_geometry_is_not_doubted(frames):
    assert named(frames, helix()) is None


@pytest.mark.parametrize(
    ("geometry", "code"),
    [
        (helix(rotation="ccw"), "rotation-sense"),
        (helix(row0="top"), "row-order"),
        (helix(8 * np.pi / VIEWS), "angle-scale"),
        (helix(2 * np.pi / VIEWS), "angle-scale"),
    ],
)
def test_a_wrong_geometry_is_named(frames, geometry, code):
    assert named(frames, geometry) == code


def test_frames_on_their_side_are_named(frames):
    side = clra.helix(
        VIEWS, angle_step=4 * np.pi / VIEWS, z_step=0.015, **{**CONE, "shape": SHAPE[::-1]}
    )
    assert named(frames.swapaxes(1, 2), side) == "transposed"


@pytest.mark.parametrize(
    ("sharpening", "doubted"), [(1.3, True), (1.0, False), (0.7, False), (float("nan"), False)]
)
def test_the_sense_of_rotation_is_doubted_where_the_other_is_sharper(sharpening, doubted):
    found = doubted_rotation(sharpening)
    assert (found is not None) == doubted
    assert found is None or ("1.30" in str(found) and "--rotation" in str(found))


def test_motions_as_large_as_the_detector_are_named():
    wave = np.sin(np.linspace(0, 6, VIEWS))
    found = large_motion(clra.Motion(shift_u=20 * wave, shift_v=2 * wave), helix())
    assert found is not None and found.code == "large-motion"
    assert float(found.measured["part_u"]) == pytest.approx(20 / SHAPE[1], rel=0.02)
    assert large_motion(clra.Motion(shift_u=5 * wave, shift_v=2 * wave), helix()) is None
