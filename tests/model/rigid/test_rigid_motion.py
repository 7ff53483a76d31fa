"""Rigid motion against points of the sample moved by hand."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from clra.errors import InputError
from clra.model.motion import Motion
from clra.model.rigid.rigid_motion import (
    RigidMotion,
    rotation_matrices,
    rotation_vectors,
    view_axes,
)
from clra.model.trajectory import circular, helix


def geometry(views=7):
    return helix(
        views,
        angle_step=0.7,
        z_step=0.3,
        source_to_axis=40.0,
        source_to_detector=100.0,
        pixel_size=0.2,
        shape=(31, 45),
    )


def random_motion(views=7, seed=0):
    random = np.random.default_rng(seed)
    return RigidMotion.of(
        geometry(views), random.normal(size=(views, 6)) * [1, 1, 1, 0.1, 0.1, 0.1]
    )


def moved(points, motion, of, view):
    """Points as the sample had them in a view: turned about the centre, then shifted."""
    axes = view_axes(of)[view]
    centre = of.source[view] + of.source_to_axis[view] * of.normal[view]
    seen = (points - centre) @ axes
    turn = Rotation.from_rotvec(motion.rotation[view].copy()).as_matrix()
    return (seen @ turn.T + motion.translation[view]) @ axes.T + centre


def test_absorbed_motion_projects_like_moved_points():
    of, motion = geometry(), random_motion()
    points = np.random.default_rng(1).uniform(-3, 3, (20, 3))
    absorbed = of.with_motion(motion).project(points)
    for view in range(of.views):
        by_hand = of.project(moved(points, motion, of, view))[view]
        assert np.allclose(absorbed[view], by_hand, atol=1e-9)


def test_motions_follow_each_other_in_the_axes_of_the_view():
    of, first, second = geometry(), random_motion(seed=2), random_motion(seed=3)
    points = np.random.default_rng(1).uniform(-3, 3, (5, 3))
    centre = of.source + of.source_to_axis[:, None] * of.normal
    together = of.with_motion(first.then(second)).project(points)
    for view, axes in enumerate(view_axes(of)):
        seen = (points - centre[view]) @ axes
        for motion in (first, second):
            turn = Rotation.from_rotvec(motion.rotation[view].copy()).as_matrix()
            seen = seen @ turn.T + motion.translation[view]
        by_hand = of.project(seen @ axes.T + centre[view])[view]
        assert np.allclose(together[view], by_hand, atol=1e-9)


def test_the_inverse_undoes_a_motion():
    of, motion = geometry(), random_motion()
    back = of.with_motion(motion.then(motion.inverse()))
    assert np.allclose(back.to_astra(), of.to_astra(), atol=1e-12)


@pytest.mark.parametrize("aside", [(0.0, 0.0), (11.0, -6.0)])
def test_translations_of_shifts_show_the_shifts_at_the_axis(aside):
    of = circular(9, source_to_axis=40.0, source_to_detector=100.0, pixel_size=0.2, shape=(31, 45))
    of = of.with_motion(Motion(shift_u=np.full(9, aside[0]), shift_v=np.full(9, aside[1])))
    random = np.random.default_rng(4)
    shifts = Motion(
        shift_u=random.uniform(-2, 2, 9),
        shift_v=random.uniform(-2, 2, 9),
        magnification=1 + random.uniform(-0.01, 0.01, 9),
    )
    rigid = RigidMotion.from_shifts(shifts, of)
    # Points near the axis, at its depth in every view.
    points = np.array([[0, 0, z] for z in (-1.5, 0.0, 1.5)])
    by_shift = of.with_motion(shifts).project(points)
    by_translation = of.with_motion(rigid).project(points)
    assert np.allclose(by_shift, by_translation, atol=1e-9)
    for name in ("shift_u", "shift_v", "magnification"):
        assert np.allclose(getattr(rigid, name), getattr(shifts, name))
    moved_centre = shifts.about(3.0, -2.0)
    assert np.allclose(rigid.about(3.0, -2.0).shift_u, moved_centre.shift_u)


@pytest.mark.parametrize("size", [0.0, 1e-9, 1e-3, 1.0, 3.0])
def test_rotation_vectors_and_matrices(size):
    vectors = size * np.random.default_rng(5).normal(size=(6, 3))
    vectors /= np.maximum(1, np.linalg.norm(vectors, axis=1) / 3)[:, None]
    matrices = rotation_matrices(vectors)
    assert np.allclose(matrices, Rotation.from_rotvec(vectors).as_matrix(), atol=1e-14)
    assert np.allclose(rotation_vectors(matrices), vectors, atol=1e-11)


def test_what_is_no_rigid_motion_is_refused():
    with pytest.raises(InputError, match="rotation"):
        RigidMotion(translation=np.zeros((4, 3)), rotation=np.zeros((5, 3)), optics=np.ones((4, 5)))
    with pytest.raises(InputError, match="found 3 views, expected 7"):
        geometry().with_motion(RigidMotion.of(geometry(3)))
    skewed = geometry()
    skewed = type(skewed)(
        source=skewed.source,
        detector=skewed.detector,
        u=skewed.u,
        v=skewed.v + 0.1 * skewed.u,
        shape=skewed.shape,
    )
    with pytest.raises(InputError, match="expected 90"):
        skewed.with_motion(RigidMotion.of(geometry()))
