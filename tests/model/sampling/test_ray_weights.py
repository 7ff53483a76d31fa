"""Weights of the two rays of a line add up to 1."""

import math

import numpy as np
import pytest

from clra.model.sampling.ray_weights import ray_weights, widened
from clra.model.trajectory import circular, helix

FAN = {"source_to_axis": 50.0, "source_to_detector": 100.0, "pixel_size": 0.5, "shape": (5, 96)}
HALF_FAN = math.atan(24 / 100)
COLUMNS = np.linspace(0, 95, 41)


def _fan_angles(geometry, columns):
    """Signed angle of each column's ray, positive toward higher columns."""
    return np.arctan((columns - geometry.principal[0, 0]) * 0.5 / 100)


def _weight_at(weights, angle, fan):
    """Weight of the ray of fan angle `fan` of the view nearest to an angle of the source."""
    geometry = weights.geometry
    angles = np.arctan2(geometry.source[:, 0], -geometry.source[:, 1])
    view = int(np.abs((angles - angle + np.pi) % (2 * np.pi) - np.pi).argmin())
    column = geometry.principal[view, 0] + np.tan(fan) * 100 / 0.5
    if not -0.5 <= column <= geometry.columns - 0.5:
        return 0.0
    return float(weights.at([column], slice(view, view + 1))[0, 0])


@pytest.mark.parametrize("degrees", [200, 210, 250, 330])
def test_the_weights_of_a_line_add_up_to_1_on_an_arc(degrees):
    weights = ray_weights(circular(3600, arc=math.radians(degrees), **FAN))
    seen_twice = 0
    for angle in np.radians(np.linspace(1, degrees - 1, 17)):
        for fan in np.linspace(-0.9, 0.9, 9) * HALF_FAN:
            # At angle b, a ray that leaves toward higher columns meets the circle again here.
            other = (angle + math.pi - 2 * fan) % (2 * math.pi)
            both = other < math.radians(degrees)
            total = _weight_at(weights, angle, fan) + both * _weight_at(weights, other, -fan)
            # The nearest view is up to a twentieth of a degree off.
            assert total == pytest.approx(1, abs=0.03)
            seen_twice += both
    assert seen_twice > 10


def test_a_short_scan_has_parkers_corners():
    arc = math.pi + 2 * HALF_FAN
    weights = ray_weights(circular(720, arc=arc, **FAN))
    table = weights.at(COLUMNS)
    assert table.min() >= 0 and table.max() <= 1
    # Every view fades where the line is seen from the arc's other end, and nowhere else.
    assert table[360] == pytest.approx(1)
    assert table[0].min() < 1e-4 and table[-1].min() < 1e-4
    assert np.abs(np.diff(table[:, 20])).max() < 0.05


@pytest.mark.parametrize("side", [-1, 1])
def test_an_offset_detector_has_wangs_weights(side):
    whole = circular(90, **FAN)
    geometry = widened(whole, -40 if side > 0 else 0, 40 if side > 0 else 0)
    geometry = geometry if side > 0 else widened(whole, 40, -40)
    weights = ray_weights(geometry)
    fan = side * _fan_angles(geometry, COLUMNS)
    # SOD sin(fan) on the near side, which has 8 columns.
    near = math.sin(math.atan(8 * 0.5 / 100))
    expected = np.sin(np.pi / 4 * (1 + np.clip(np.sin(fan) / near, -1, 1))) ** 2
    assert weights.at(COLUMNS, slice(3, 5)) == pytest.approx(np.stack([expected] * 2), abs=1e-9)
    assert weights.beyond == ((80, 0) if side > 0 else (0, 80))


def test_weights_of_a_subset_stay_what_they_are():
    weights = ray_weights(circular(100, arc=math.radians(220), **FAN))
    some = weights.subset(np.r_[3:9, 40:99])
    assert np.array_equal(some.at(COLUMNS), weights.at(COLUMNS)[np.r_[3:9, 40:99]])


@pytest.mark.parametrize(
    "geometry",
    [
        circular(90, **FAN),
        circular(90, arc=math.radians(150), **FAN),
        circular(1, **FAN),
        helix(90, angle_step=0.1, z_step=0.2, **FAN),
    ],
)
def test_scans_whose_rays_are_all_alike(geometry):
    assert ray_weights(geometry) is None
