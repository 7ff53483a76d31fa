"""Views put into helices that lack some, against the helices that lack none."""

import numpy as np
import pytest

import clra
from clra.model.helix.gaps import completed

DETECTOR = {
    "source_to_axis": 30.0,
    "source_to_detector": 61.0,
    "pixel_size": 0.5,
    "shape": (41, 33),
}
FIELDS = ("source", "detector", "u", "v")


def _helix(step=0.03, z_step=0.05, views=90, **more):
    return clra.helix(views, angle_step=step, z_step=z_step, **DETECTOR, **more)


def _without(geometry, missing):
    return geometry.subset(np.setdiff1d(np.arange(geometry.views), missing))


def _is(found, expected):
    for name in FIELDS:
        np.testing.assert_allclose(getattr(found, name), getattr(expected, name), atol=1e-9)


@pytest.mark.parametrize(
    ("geometry", "missing"),
    [
        (_helix(), [40]),
        (_helix(), [5, 7, 9, 60, 61, 62]),
        (_helix(step=-0.03, start=2.0), [1, 88]),
        (_helix(z_step=-0.05, start=3.1), [3, 4]),  # across half a turn
        (_helix(step=0.1), [11, 30]),
        (clra.double_helix(60, angle_step=0.03, z_step=0.05, **DETECTOR), [20, 80, 81]),
    ],
)
def test_what_is_missing_is_put_in(geometry, missing):
    found, views = completed(_without(geometry, missing))
    _is(found, geometry)
    assert np.flatnonzero(views < 0).tolist() == missing
    assert views[views >= 0].tolist() == list(range(geometry.views - len(missing)))


@pytest.mark.parametrize(
    "geometry",
    [
        _helix(),
        _without(_helix(), range(40, 44)),  # 7 degrees
        _without(_helix(step=0.1), [20, 21]),
        _without(_helix(), [0, 89]),
        _without(clra.circular(60, **DETECTOR), [30]),
        clra.space_filling(90, z_step=0.01, **DETECTOR),
        clra.double_helix(60, angle_step=0.03, z_step=0.05, **DETECTOR),
        _helix(views=1),
        _helix(views=2),
    ],
)
def test_other_trajectories_stay_as_they_are(geometry):
    found, views = completed(geometry)
    assert found is geometry
    assert views.tolist() == list(range(geometry.views))


@pytest.mark.parametrize("step", [0.03, -0.03])
def test_the_last_of_views_that_repeat_each_other_stays(step):
    whole = _helix(step=step)
    found, views = completed(whole.subset([0, *range(40), 39, 39, *range(41, 90)]))
    _is(found, whole)
    # Frame 0 was taken twice, 39 three times, 40 not at all.
    assert views.tolist() == [*range(1, 40), 42, -1, *range(43, 92)]
