"""Views of a circle stand for parts of the turn."""

import math

import numpy as np
import pytest

import clra
from clra.model.sampling.angular_coverage import (
    angle_weights,
    holes,
    is_whole_circle,
    part_of_a_turn,
)
from clra.model.trajectory import circular, helix

DETECTOR = {
    "source_to_axis": 50.0,
    "source_to_detector": 100.0,
    "pixel_size": 0.5,
    "shape": (7, 96),
}
PARALLEL = DETECTOR | {"source_to_axis": 5e4, "source_to_detector": 5e4}


def _joined(*parts):
    return clra.ConeBeamGeometry.from_astra(
        np.concatenate([part.to_astra() for part in parts]), (7, 96)
    )


@pytest.mark.parametrize("views", [1, 2, 7, 360])
@pytest.mark.parametrize("turns", [0.5, 0.6, 1, 2, -3])
def test_even_views_weigh_the_same_also_on_a_part_of_the_turn(views, turns):
    geometry = circular(views, arc=2 * math.pi * turns, start=0.3, **DETECTOR)
    assert (angle_weights(geometry) == 1).all()


def test_helices_are_left_alone():
    assert (angle_weights(helix(50, angle_step=0.3, z_step=0.1, **DETECTOR)) == 1).all()


@pytest.mark.parametrize("shuffled", [False, True])
def test_views_weigh_as_much_as_the_angle_they_stand_for(shuffled):
    dense = circular(240, arc=math.pi / 2, **DETECTOR)
    sparse = circular(120, arc=1.5 * math.pi, start=math.pi / 2, **DETECTOR)
    order = np.random.default_rng(0).permutation(360) if shuffled else np.arange(360)
    weights = np.empty(360)
    weights[order] = angle_weights(_joined(dense, sparse).subset(order))
    assert weights.mean() == pytest.approx(1)
    # A quarter of the turn has 240 views, three quarters have 120.
    assert weights[6:234] == pytest.approx(0.25 * 360 / 240)
    assert weights[246:354] == pytest.approx(0.75 * 360 / 120)


def test_what_is_seen_in_two_turns_weighs_half_in_each():
    weights = angle_weights(circular(300, arc=3 * math.pi, **DETECTOR))
    # In units of the first half of the turn's: 200 views of 1/2 and 100 of 1 have a mean of 2/3.
    assert weights[np.r_[6:94, 206:294]] == pytest.approx(0.5 / (2 / 3))
    assert weights[106:194] == pytest.approx(1 / (2 / 3))


@pytest.mark.parametrize(
    ("geometry", "covered"),
    [
        (
            circular(180, arc=math.radians(195), **DETECTOR),
            "195 degrees of the circle",
        ),
        (circular(180, arc=math.pi, **DETECTOR), "180 degrees"),
        (circular(180, arc=0.9 * math.pi, **PARALLEL), "162 degrees of the circle, expected at"),
        # The full fan is 2 atan(0.24) = 27 degrees wide.
        (circular(180, arc=math.radians(208), **DETECTOR), ""),
        (circular(180, arc=1.5 * math.pi, **PARALLEL), ""),
        (circular(180, **DETECTOR), ""),
        (circular(270, arc=3 * math.pi, **DETECTOR), ""),
        (circular(180, arc=math.pi, **PARALLEL), ""),
        (circular(180, **DETECTOR).subset(np.r_[0:50, 53:180]), ""),
        (circular(1, **DETECTOR), ""),
        (helix(50, angle_step=0.05, z_step=0.1, **DETECTOR), ""),
    ],
)
def test_an_arc_that_does_not_measure_all_rays_is_warned_of(geometry, covered):
    warned = part_of_a_turn(geometry)
    assert covered in warned and bool(warned) == bool(covered)


def test_holes_begin_half_a_step_after_the_last_view():
    missing = holes(circular(90, arc=1.5 * math.pi, start=0.5, **DETECTOR))
    step = math.pi / 60
    assert missing == pytest.approx(np.array([[0.5 + 1.5 * math.pi - step / 2, 0.5 * math.pi]]))


@pytest.mark.parametrize(
    ("geometry", "whole"),
    [
        (circular(90, **DETECTOR), True),
        (circular(90, arc=math.radians(300), **DETECTOR), False),
        (helix(90, angle_step=0.2, z_step=0.1, **DETECTOR), False),
    ],
)
def test_whole_circles(geometry, whole):
    assert is_whole_circle(geometry) == whole
