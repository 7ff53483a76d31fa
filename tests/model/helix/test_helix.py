"""Curves on the detector against the projections of the helix itself; fits against what was put
in."""

import math

import numpy as np
import pytest

import clra
from clra.model.geometry import ConeBeamGeometry
from clra.model.grid import VolumeGrid
from clra.model.helix.fit import fit_helices
from clra.model.helix.helix import Helix
from clra.model.helix.pi_intervals import field_of_view, pi_reach, pi_spans

PIXELS = 1e-9
DETECTOR = {
    "source_to_axis": 30.0,
    "source_to_detector": 61.0,
    "pixel_size": 0.5,
    "shape": (41, 33),
}


def helix(z_step: float = 0.05, pitch_v: float = 0.4, pitch_u: float = 0.5) -> Helix:
    return Helix(
        views=141,
        start=0.7,
        angle_step=0.09,
        z=-2.0,
        z_step=z_step,
        source_to_axis=30.0,
        source_to_detector=61.0,
        principal=(17.3, 21.6),
        pitch_u=pitch_u,
        pitch_v=pitch_v,
        shape=(41, 33),
    )


def projections(one: Helix, view: int, ahead: np.ndarray) -> np.ndarray:
    """Pixels (column, row) of helix positions an angle ahead of a view's source."""
    b = one.start + view * one.angle_step + ahead
    z = one.z + view * one.z_step + ahead * one.z_step / one.angle_step
    points = np.stack([one.source_to_axis * np.sin(b), -one.source_to_axis * np.cos(b), z], axis=1)
    return one.geometry().subset(slice(view, view + 1)).project(points)[0]


HELICES = [helix(), helix(z_step=-0.05), helix(pitch_v=-0.4), helix(pitch_u=-0.5)]


@pytest.mark.parametrize("one", HELICES)
def test_window_is_the_shadow_of_the_next_turns(one):
    for border, ahead in enumerate([np.linspace(2.2, 4.0, 7), -np.linspace(2.2, 4.0, 7)]):
        column, row = projections(one, 60, ahead).T
        expected = one.row(one.window(one.tangent_u(column))[border])
        np.testing.assert_allclose(row, expected, atol=PIXELS)


@pytest.mark.parametrize("one", HELICES)
@pytest.mark.parametrize("psi", [-1.7, -0.4, 0.2, 1.1, 1.8])
def test_kappa_lines_meet_the_helix_twice(one, psi):
    column, row = projections(one, 60, np.array([psi, 2 * psi])).T
    first, second = one.kappa_line(psi)
    # A point of the helix behind the source's plane has its projection on the line as well.
    seen = np.isfinite(column)
    assert seen.any() or abs(psi) < 0.8
    expected = one.row(first + second * one.tangent_u(column[seen]))
    np.testing.assert_allclose(row[seen], expected, atol=PIXELS)


@pytest.mark.parametrize("one", HELICES)
def test_heights_of_the_window_have_their_shadows_on_its_borders(one):
    x, y = np.array([3.0, -2.0, 5.0]), np.array([1.0, 4.0, -3.5])
    ahead, behind, depth = one.pi_heights(9, x, y)
    view = one.geometry().subset(slice(9, 10))
    np.testing.assert_allclose(
        depth, (view.projection_matrices()[0] @ np.stack([x, y, ahead, np.ones(3)]))[2]
    )
    for border, z in enumerate([ahead, behind]):
        column, row = view.project(np.stack([x, y, z], axis=1))[0].T
        np.testing.assert_allclose(row, one.row(one.window(one.tangent_u(column))[border]))
    low, high = pi_reach(one, 9, 6.5)
    assert low < min(ahead.min(), behind.min()) and high > max(ahead.max(), behind.max())


@pytest.mark.parametrize("one", HELICES)
def test_filter_lines_hold_the_window(one):
    radius = 5.0
    edge = math.tan(one.fan(radius))
    rows = one.row(np.stack(one.window(np.linspace(-edge, edge, 101))))
    low, high = one.rows_needed(radius)
    assert low <= rows.min() + 1e-6 and high >= rows.max() - 1e-6
    first, last = one.window_rows(radius)
    assert first <= max(rows.min(), 0) and last > min(rows.max(), one.shape[0] - 1)


@pytest.mark.parametrize("one", HELICES)
def test_spans_are_what_the_ends_have_yet_to_see_or_have_left(one):
    grid = VolumeGrid(shape=(60, 3, 4), voxel_size=0.2, centre=(1.0, 0.5, 1.0))
    spans = pi_spans(one, grid, 1.35)
    x, y, z = grid.coordinates()
    for j, i in np.ndindex(3, 4):
        if np.hypot(x[i], y[j]) > 1.35:
            assert spans[j, i, 0] > spans[j, i, 1]
            continue
        held = np.ones(60, bool)
        for view in (0, one.views - 1):
            window = np.sort(np.array(one.pi_heights(view, x[i], y[j])[:2]))
            held &= (z < window[0]) | (z > window[1])
        middle = np.abs(z - one.z - 0.5 * one.views * one.z_step) < 4.5
        inside = (np.arange(60) >= spans[j, i, 0]) & (np.arange(60) <= spans[j, i, 1])
        assert inside[middle].any()
        assert not (inside & ~held).any()


@pytest.mark.parametrize("one", HELICES)
def test_fit_finds_the_helix(one):
    ((views, found),) = fit_helices(one.geometry())
    assert views == slice(0, one.views)
    assert found.principal == pytest.approx(one.principal, abs=1e-8)
    assert found.start % (2 * math.pi) == pytest.approx(one.start)
    for name in ("angle_step", "z", "z_step", "source_to_axis", "source_to_detector", "pitch_u"):
        assert getattr(found, name) == pytest.approx(getattr(one, name))
    assert found.between().geometry().source[4] == pytest.approx(
        0.5 * (one.geometry().source[4] + one.geometry().source[5]), rel=2e-3
    )
    cropped = found.cropped(3, 20).geometry()
    pixels = one.geometry().project([[1.0, 2.0, -1.0]]) - [0, 3]
    np.testing.assert_allclose(cropped.project([[1.0, 2.0, -1.0]]), pixels, atol=1e-7)


@pytest.mark.parametrize("second", ["half-turn", "return"])
def test_fit_finds_both_helices(second):
    geometry = clra.double_helix(50, angle_step=0.05, z_step=0.02, second=second, **DETECTOR)
    (first, one), (later, other) = fit_helices(geometry)
    assert (first, later) == (slice(0, 50), slice(50, 100))
    assert one.z_step == pytest.approx(-other.z_step)
    assert math.copysign(1, one.slope * other.slope) == (1 if second == "half-turn" else -1)


def _moved(view: int, distance: float) -> ConeBeamGeometry:
    straight = clra.helix(40, angle_step=0.05, z_step=0.02, **DETECTOR)
    detector = straight.detector.copy()
    detector[view] += distance * straight.u[view]
    return ConeBeamGeometry(
        source=straight.source,
        detector=detector,
        u=straight.u,
        v=straight.v,
        shape=straight.shape,
    )


def test_sixty_views_a_turn_are_enough():
    detector = {
        "source_to_axis": 4.0,
        "source_to_detector": 8.0,
        "pixel_size": 0.1,
        "shape": (9, 9),
    }
    helix = clra.helix(120, angle_step=2 * math.pi / 60, z_step=0.05, **detector)
    assert len(fit_helices(helix)) == 1


def test_what_is_no_helix():
    circle = clra.circular(40, **DETECTOR)
    with pytest.raises(ValueError, match=r"no rise .* expected a helix"):
        fit_helices(circle)
    with pytest.raises(ValueError, match=r"found 15.* degrees from view to view, .* at most 6"):
        fit_helices(clra.space_filling(400, z_step=0.01, **DETECTOR))
    with pytest.raises(ValueError, match=r"view 17 is 0.9.* pixels off .* at most 0.1"):
        fit_helices(_moved(17, 1.0))
    fit_helices(_moved(17, 0.05))
    stopped = clra.helix(40, angle_step=0.05, z_step=0.02, **DETECTOR)
    with pytest.raises(ValueError, match="view 39 continues no helix"):
        fit_helices(stopped.subset([*range(39), 3]))


def test_a_field_that_fits_and_advice_that_helps():
    grid = VolumeGrid(shape=(9, 40, 40), voxel_size=0.2)

    def one(z_step, rows=41, pixel=0.5):
        detector = DETECTOR | {"shape": (rows, 33), "pixel_size": pixel}
        return fit_helices(clra.helix(99, angle_step=0.05, z_step=z_step, **detector))[0][1]

    assert field_of_view([one(0.03)], grid) == one(0.03).field_radius
    with pytest.raises(ValueError, match="less than the Tam-Danielsson window") as caught:
        field_of_view([one(0.14)], grid)
    words = str(caught.value).split()
    assert "\n" not in str(caught.value)
    pitch = float(words[words.index("pitch") + 4])
    field_of_view([one(0.9999 * pitch * 0.05 / (2 * math.pi))], grid)
    with pytest.raises(ValueError):
        field_of_view([one(1.01 * pitch * 0.05 / (2 * math.pi))], grid)
    low, high = (int(words[words.index("rows", 5) + k].strip(",")) for k in (1, 3))
    field_of_view([one(0.14, rows=high - low + 1)], grid)
    with pytest.raises(ValueError):
        field_of_view([one(0.14, rows=high - low - 3)], grid)
    width = float(words[words.index("view") + 4])
    narrow = VolumeGrid(shape=(9, 10, 10), voxel_size=width / 10)
    assert field_of_view([one(0.14)], narrow) == pytest.approx(width / 2)


def test_a_pitch_too_small_for_the_rows():
    grid = VolumeGrid(shape=(9, 40, 40), voxel_size=0.2)

    def one(pitch):
        steps = {"angle_step": 0.05, "z_step": pitch * 0.05 / (2 * math.pi)}
        return fit_helices(clra.helix(150, **steps, **DETECTOR))[0][1]

    with pytest.raises(
        ValueError, match="window of 2 rows, expected a pitch of at least"
    ) as caught:
        field_of_view([one(0.98)], grid)
    least = float(str(caught.value).split("at least ")[1].split()[0])
    assert field_of_view([one(1.001 * least)], grid) > 0
