"""Trajectories by their definition, and the lattice of the space-filling one."""

import math

import numpy as np
import pytest

from clra.errors import InputError
from clra.model.geometry import ConeBeamGeometry
from clra.model.trajectory import (
    PAPER,
    circular,
    double_helix,
    helix,
    lattice_angle,
    space_filling,
)

ROUNDING = 1e-12
STAGE = {"source_to_axis": 4.0, "source_to_detector": 10.0, "pixel_size": 0.3, "shape": (5, 7)}


def at(angle, z):
    """One view by the definition."""
    sin, cos = math.sin(angle), math.cos(angle)
    return ConeBeamGeometry(
        source=[[4 * sin, -4 * cos, z]],
        detector=[[-6 * sin, 6 * cos, z]],
        u=[[0.3 * cos, 0.3 * sin, 0]],
        v=[[0, 0, 0.3]],
        shape=(5, 7),
    )


def assert_views(geometry, angles, heights):
    expected = [at(b, z).to_astra()[0] for b, z in zip(angles, heights, strict=True)]
    np.testing.assert_allclose(geometry.to_astra(), expected, atol=ROUNDING)


def test_circle():
    assert_views(circular(4, **STAGE), np.radians([0, 90, 180, 270]), [0, 0, 0, 0])
    arc = circular(3, start=0.5, arc=-0.9, **STAGE)
    assert_views(arc, [0.5, 0.2, -0.1], [0, 0, 0])
    assert arc.axial


def test_source_and_detector_face_each_other_across_the_axis():
    geometry = circular(5, **STAGE)
    np.testing.assert_allclose(geometry.source_to_axis, 4)
    np.testing.assert_allclose(geometry.source_to_detector, 10)
    np.testing.assert_allclose(geometry.principal, [[3, 2]] * 5, atol=1e-9)
    # u, the ray and v form a right-handed frame.
    ray = geometry.detector - geometry.source
    np.testing.assert_allclose(np.cross(geometry.u, ray) @ [0, 0, 1], 3)


def test_helix():
    assert_views(
        helix(4, angle_step=0.3, z_step=-0.5, start=1, **STAGE),
        [1, 1.3, 1.6, 1.9],
        [0.75, 0.25, -0.25, -0.75],
    )


def test_double_helix_with_a_half_turn_is_the_first_helix_turned_and_followed_back():
    geometry = double_helix(3, angle_step=0.3, z_step=0.5, start=1, **STAGE)
    turn = 1 + math.pi
    assert_views(
        geometry, [1, 1.3, 1.6, turn + 0.6, turn + 0.3, turn], [-0.5, 0, 0.5, 0.5, 0, -0.5]
    )
    opposite = geometry.source[:3] * [-1, -1, 1]
    np.testing.assert_allclose(geometry.source[:2:-1], opposite, atol=ROUNDING)


def test_double_helix_that_returns_turns_on():
    geometry = double_helix(3, angle_step=0.3, z_step=0.5, second="return", **STAGE)
    assert_views(geometry, 0.3 * np.arange(6), [-0.5, 0, 0.5, 0.5, 0, -0.5])
    with pytest.raises(ValueError, match="second: found 'forth', expected 'half-turn' or 'return'"):
        double_helix(3, angle_step=0.3, z_step=0.5, second="forth", **STAGE)


def test_space_filling_is_a_helix_with_the_lattice_angle():
    geometry = space_filling(6, z_step=0.01, start=0.1, **STAGE)
    angle = lattice_angle(4.0, 0.01)
    assert geometry == helix(6, angle_step=angle, z_step=0.01, start=0.1, **STAGE)
    given = space_filling(6, z_step=0.01, angle_step=0.2, **STAGE)
    assert given == helix(6, angle_step=0.2, z_step=0.01, **STAGE)


def spread(angle, rise, reach=2000):
    """Shortest distance of the lattice as a part of the hexagonal one, by brute force."""
    n = np.arange(1, reach)
    around = np.angle(np.exp(1j * n * angle))
    return np.hypot(around, n * rise).min() / math.sqrt(4 * math.pi * rise / math.sqrt(3))


def test_lattice_angle_of_the_paper():
    angle = lattice_angle(PAPER["source_to_axis"], PAPER["z_step"])
    assert math.degrees(angle) == pytest.approx(15.264, abs=0.003)
    rise = PAPER["z_step"] / PAPER["source_to_axis"]
    assert spread(angle, rise) == pytest.approx(0.930, abs=0.002)
    assert spread(math.radians(15.3), rise) == pytest.approx(0.453, abs=0.002)


@pytest.mark.parametrize("rise", [1.0, 0.1, 0.01, 1e-3, 1e-5])
@pytest.mark.parametrize("near", [0.3, 1.1, 2.4])
def test_lattice_angle_is_a_local_maximum_better_than_the_square_lattice(rise, near):
    angle = lattice_angle(1.0, rise, near)
    best = spread(angle, rise)
    for aside in (1e-3, 1e-2):
        step = aside * rise
        assert spread(angle - step, rise) < best
        assert spread(angle + step, rise) < best
    assert 1 >= best > math.sqrt(math.sqrt(3) / 2) - 1e-3


def test_lattice_angle_does_not_depend_on_unit_or_direction():
    angle = lattice_angle(4.0, 0.01)
    assert lattice_angle(4e-3, 1e-5) == pytest.approx(angle, abs=1e-9)
    assert lattice_angle(4.0, -0.01) == angle


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: circular(0, **STAGE), "views: found 0"),
        (lambda: circular(3, **(STAGE | {"source_to_axis": -4})), "source_to_axis: found -4.0"),
        (lambda: circular(3, **(STAGE | {"pixel_size": 0})), "pixel_size: found 0.0"),
        (lambda: circular(3, arc=math.nan, **STAGE), "arc: found nan"),
        (lambda: helix(3, angle_step=1, z_step=math.inf, **STAGE), "z_step: found inf"),
        (lambda: space_filling(3, z_step=0, **STAGE), "z_step: found 0, expected a rise"),
        (lambda: lattice_angle(1, 0.1, 4.0), "near: found 4.0"),
    ],
)
def test_wrong_values_are_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def seen_from_above(angle, point, z):
    """Pixel (column, row) of a point of a sample that turns before a standing detector."""
    c, s = math.cos(angle), math.sin(angle)
    x, y = c * point[0] - s * point[1], s * point[0] + c * point[1]
    enlarged = 10.0 / (4.0 + y)  # the beam runs along +y
    return x * enlarged / 0.3, (point[2] - z) * enlarged / 0.3


@pytest.mark.parametrize("rotation", ["cw", "ccw"])
@pytest.mark.parametrize("row0", ["top", "bottom"])
@pytest.mark.parametrize(
    ("make", "angles", "heights"),
    [
        (lambda **w: circular(5, **w), [2 * math.pi * i / 5 for i in range(5)], [0] * 5),
        (lambda **w: helix(3, angle_step=0.7, z_step=0.2, **w), [0, 0.7, 1.4], [-0.2, 0, 0.2]),
        (
            lambda **w: double_helix(2, angle_step=0.7, z_step=0.2, second="return", **w),
            [0, 0.7, 1.4, 2.1],
            [-0.1, 0.1, 0.1, -0.1],
        ),
        (
            lambda **w: space_filling(3, angle_step=2.4, z_step=0.2, **w),
            [0, 2.4, 4.8],
            [-0.2, 0, 0.2],
        ),
    ],
)
def test_words_for_the_sense_of_rotation_and_the_rows(make, angles, heights, rotation, row0):
    geometry = make(rotation=rotation, row0=row0, **STAGE)
    point = np.array([0.3, -0.2, 0.15])
    found = geometry.project(point[None])[:, 0]
    sense, up = (1 if rotation == "ccw" else -1), (1 if row0 == "bottom" else -1)
    for pixel, angle, z in zip(found, angles, heights, strict=True):
        column, row = seen_from_above(sense * angle, point, z)
        np.testing.assert_allclose(pixel, (3 + column, 2 + up * row), atol=1e-9)
    assert f"sample turns {rotation}, row 0 at the {row0}" in repr(geometry)


@pytest.mark.parametrize(
    ("make", "name"),
    [
        (lambda: circular(9, arc=360.0, **STAGE), "arc"),
        (lambda: helix(9, angle_step=15.3, z_step=0.1, **STAGE), "angle_step"),
        (lambda: double_helix(9, angle_step=-15.3, z_step=0.1, **STAGE), "angle_step"),
        (lambda: space_filling(9, angle_step=137.5, z_step=0.1, **STAGE), "angle_step"),
    ],
)
def test_degrees_are_refused(make, name):
    with pytest.raises(InputError, match=rf"{name}: found .* radians; .* degrees are math.radians"):
        make()


@pytest.mark.parametrize("word", ["rotation", "row0"])
def test_unknown_words_are_refused(word):
    with pytest.raises(InputError, match=f"{word}: found 'up', expected one of"):
        circular(9, **{word: "up"}, **STAGE)
