"""Rigid motion of the sample is found on closed-form scans."""

from dataclasses import replace

import numpy as np
import pytest

import clra
from clra.errors import Cancelled, InputError
from clra.methods.alignment.result import AlignmentInterrupted
from clra.methods.alignment.rigid.rigid_solution import solve
from clra.model.grid import default_grid
from clra.model.phantoms.ellipsoids import Ellipsoids
from clra.model.rigid.rigid_gauge import between, without_rigid_gauge
from clra.model.rigid.rigid_motion import RigidMotion

VIEWS, SIZE = 60, 48
# Shifts alone leave 0.05 and 0.04 pixel.
SHIFT, ANGLE = 0.012, 0.16


def balls() -> Ellipsoids:
    random = np.random.default_rng(3)
    centres = random.uniform(-0.25, 0.25, (30, 3)) * SIZE
    return Ellipsoids(centres, random.uniform(1.5, 4, 30), random.uniform(0.02, 0.06, 30))


@pytest.fixture(scope="module")
def scan():
    ideal = clra.circular(
        VIEWS,
        source_to_axis=2.5 * SIZE,
        source_to_detector=3.75 * SIZE,
        pixel_size=1.5,
        shape=(64, 64),
    )
    size = [1.5, 1.5, 0.5, *np.radians([0.4, 0.4, 0.4])]
    table = size * np.random.default_rng(4).uniform(-1, 1, (VIEWS, 6))
    true = ideal.with_motion(RigidMotion.of(ideal, table))
    return clra.Scan(balls().line_integrals(true, oversample=2), ideal), true


@pytest.fixture(scope="module")
def aligned(scan):
    return clra.align(scan[0], estimate="rigid")


def test_shifts_and_rotations_are_found(scan, aligned):
    ideal, true = scan[0].geometry, scan[1]
    points = balls().centres
    # The sample as a whole may lie elsewhere.
    truth = between(ideal, true)
    found = without_rigid_gauge(aligned.motion, ideal, points, reference=truth)
    wrong = between(true, ideal.with_motion(found))
    assert np.abs(wrong.shift_u).mean() < SHIFT and np.abs(wrong.shift_v).mean() < SHIFT
    assert np.degrees(wrong.rotation.std(axis=0)).max() < ANGLE


def test_sigma_covers_shifts_magnification_and_rotations(aligned):
    assert aligned.sigma.shape == (VIEWS, 6)
    assert np.isfinite(aligned.sigma).all() and (aligned.sigma > 0).all()


def test_the_alignment_file_keeps_rigid_motion(aligned, tmp_path):
    clra.write_alignment(tmp_path / "motion.h5", aligned)
    assert clra.read_alignment(tmp_path / "motion.h5") == aligned


def test_reconstruction_takes_it_and_resampling_refuses_it(scan, aligned):
    sharp = clra.reconstruct(scan[0], alignment=aligned)
    moved = clra.Scan(scan[0].projections, scan[0].geometry.with_motion(aligned.motion))
    grid = default_grid(scan[0].geometry)
    assert sharp == pytest.approx(clra.reconstruct(moved, grid=grid), abs=1e-4 * float(sharp.max()))
    with pytest.raises(InputError, match="rotations of the sample"):
        clra.correct(scan[0], aligned)


def test_checksums_tell_rotations_apart(aligned):
    table = aligned.motion.table.copy()
    table[:, 5] *= -1
    other = replace(aligned, motion=aligned.motion.with_table(table))
    assert other.checksum_of_motion() != aligned.checksum_of_motion()


@pytest.mark.parametrize("error", [Cancelled, KeyboardInterrupt])
def test_the_shifts_stay_if_it_is_ended_while_it_looks_for_rotations(scan, error):
    def progress(told):
        if "rigid" in told.stage:
            raise error

    def align():
        return clra.align(scan[0], estimate="rigid", progress=progress, quality=False)

    if error is Cancelled:
        with pytest.warns(clra.ClraWarning, match="ended early"):
            kept = align()
    else:
        with pytest.raises(AlignmentInterrupted) as stopped:
            align()
        kept = stopped.value.result
    assert kept.motion.cause == "detector" and np.abs(kept.motion.shift_u).max() > 0.5


def test_normal_equations_are_solved_view_by_view():
    random = np.random.default_rng(5)
    images = random.normal(size=(3, 8, 400))
    true = random.normal(size=(3, 7))
    images[:, 7] = np.einsum("nk,nkp->np", true, images[:, :7]) + 0.01 * images[:, 7]
    gram = np.einsum("nip,njp->nij", images, images)
    totals = np.stack([one[np.triu_indices(8)] for one in gram])
    found = solve(totals, (0, 1, 2, 3, 4, 5), np.zeros(6), 400.0, 0.0)
    assert np.abs(found.table - true[:, :6]).max() < 0.004
    assert np.allclose(found.sigma, 0.01 / 20, rtol=0.3)
    held = solve(totals, (0, 1, 5), np.array([0, 0, 0, 0, 0, 1e-9]), 400.0, 0.0)
    assert np.abs(held.table[:, 5]).max() < 1e-6 and np.isnan(held.sigma[:, 2:5]).all()
