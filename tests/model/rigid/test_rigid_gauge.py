"""Movements of the sample as a whole are found and taken out of rigid motion."""

import numpy as np

from clra.model.geometry import ConeBeamGeometry
from clra.model.rigid.rigid_gauge import between, without_rigid_gauge
from clra.model.rigid.rigid_motion import RigidMotion, rotation_matrices
from clra.model.trajectory import helix


def scan(views=24):
    return helix(
        views,
        angle_step=0.6,
        z_step=0.2,
        source_to_axis=40.0,
        source_to_detector=100.0,
        pixel_size=0.2,
        shape=(31, 45),
    )


POINTS = np.random.default_rng(7).uniform(-3, 3, (150, 3))


def test_motion_between_geometries_is_that_which_was_absorbed():
    random = np.random.default_rng(0)
    motion = RigidMotion.of(scan(), random.normal(size=(24, 6)) * [1, 1, 1, 0.2, 0.2, 0.2])
    found = between(scan(), scan().with_motion(motion))
    assert np.allclose(found.table, motion.table, atol=1e-12)


def test_a_moved_sample_is_no_motion():
    nominal = scan()
    turn = rotation_matrices(np.array([[0.01, -0.02, 0.03]]))[0]
    moved = ConeBeamGeometry(
        source=(nominal.source - [0.1, 0.2, -0.1]) @ turn,
        detector=(nominal.detector - [0.1, 0.2, -0.1]) @ turn,
        u=nominal.u @ turn,
        v=nominal.v @ turn,
        shape=nominal.shape,
    )
    motion = between(nominal, moved)
    assert np.abs(motion.table).max() > 0.01
    rest = without_rigid_gauge(motion, nominal, POINTS)
    assert np.abs(rest.table).max() < 1e-7


def test_jitter_stays():
    random = np.random.default_rng(1)
    size = [0.05, 0.05, 0.05, 0.002, 0.002, 0.002]
    jitter = RigidMotion.of(scan(), size * random.normal(size=(24, 6)))
    once = without_rigid_gauge(jitter, scan(), POINTS)
    twice = without_rigid_gauge(once, scan(), POINTS)
    assert np.allclose(once.table, twice.table, atol=1e-4)  # depth comes after the least squares
    left = once.table.std(axis=0) / jitter.table.std(axis=0)
    assert (left > 0.7).all() and (left < 1.1).all()
    kept = without_rigid_gauge(jitter, scan(), POINTS, reference=jitter)
    assert np.allclose(kept.table, jitter.table, atol=1e-7)
