"""Rigid motion of the sample is found on closed-form scans."""

from dataclasses import replace

import numpy as np
import pytest
from rigid_samples import VIEWS, balls, moved_scan

import clra
from clra.errors import Cancelled, InputError
from clra.methods.alignment.options import Solver
from clra.methods.alignment.result import AlignmentInterrupted
from clra.methods.alignment.rigid.rigid_level import RigidLevel
from clra.methods.alignment.rigid.rigid_solution import equations, solve
from clra.methods.execution.checkpoint import Checkpoint
from clra.model.grid import default_grid
from clra.model.rigid.rigid_gauge import between, without_rigid_gauge
from clra.ops.streaming.radiographs import Radiographs
from clra.ops.streaming.stream import Stream

# Shifts alone leave 0.05 and 0.04 pixel.
SHIFT, ANGLE, ROLL = 0.012, 0.16, 0.1


@pytest.fixture(scope="module")
def scan():
    return moved_scan([1.5, 1.5, 0.5, *np.radians([0.4, 0.4, 0.4])])


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


def solved(totals, free, prior):
    return solve(equations(totals, free, 400.0, 0.0), free, prior)


def test_normal_equations_are_solved_view_by_view():
    random = np.random.default_rng(5)
    images = random.normal(size=(3, 8, 400))
    true = random.normal(size=(3, 7))
    images[:, 7] = np.einsum("nk,nkp->np", true, images[:, :7]) + 0.01 * images[:, 7]
    gram = np.einsum("nip,njp->nij", images, images)
    totals = np.stack([one[np.triu_indices(8)] for one in gram])[:, None]
    found = solved(totals, (0, 1, 2, 3, 4, 5), np.zeros(6))
    assert np.abs(found.table - true[:, :6]).max() < 0.004
    assert np.allclose(found.sigma, 0.01 / 20, rtol=0.3)
    held = solved(totals, (0, 1, 5), np.array([0, 0, 0, 0, 0, 1e-9]))
    assert np.abs(held.table[:, 5]).max() < 1e-6 and np.isnan(held.sigma[:, 2:5]).all()


@pytest.mark.parametrize(
    ("estimate", "free"), [("shift+roll", (0, 1, 5)), ("shift+scale+roll", (0, 1, 2, 5))]
)
def test_fewer_parameters_are_found_by_themselves(estimate, free):
    size = [1.5, 1.5, 0, 0, 0, np.radians(0.6)]
    size[2] = 1.0 if 2 in free else 0.0
    moved, true = moved_scan(size)
    aligned = clra.align(moved, estimate=estimate, quality=False)
    truth = between(moved.geometry, true)
    points = balls().centres
    motion = without_rigid_gauge(aligned.motion, moved.geometry, points, reference=truth)
    wrong = between(true, moved.geometry.with_motion(motion))
    left, whole = (np.degrees(m.rotation[:, 2].std()) for m in (wrong, truth))
    assert left < ROLL < 0.4 * whole
    assert np.abs(wrong.shift_u).mean() < SHIFT and np.abs(wrong.shift_v).mean() < SHIFT
    known = np.isfinite(aligned.sigma).all(axis=0)
    assert tuple(np.flatnonzero(known)) == free


class Killed(BaseException):
    """Ends a call without giving it a chance to clean up."""


def test_a_killed_alignment_goes_on_as_if_it_had_not_been(scan, aligned, tmp_path, monkeypatch):
    save, done = Checkpoint.save, []

    def saving(self, kept, values, arrays, volume=None):
        save(self, kept, values, arrays, volume)
        done.extend(["rigid"] * ("rigid" in values))
        if len(done) == 5:  # in the middle of the second resolution, whose bias is known
            raise Killed

    monkeypatch.setattr(Checkpoint, "save", saving)
    with pytest.raises(Killed):
        clra.align(scan[0], estimate="rigid", quality=False, checkpoint=tmp_path / "kept")
    stages = []
    again = clra.align(
        scan[0],
        estimate="rigid",
        quality=False,
        checkpoint=tmp_path / "kept",
        resume=True,
        progress=lambda told: stages.append(told.stage),
    )
    assert again.motion == aligned.motion
    assert np.array_equal(again.confidence, aligned.confidence)
    assert [i.residual for i in again.history] == [i.residual for i in aligned.history]
    assert not any("QR" in stage for stage in stages)  # the shifts are not looked for again


def test_an_alignment_starts_from_rigid_motion(scan, aligned):
    start = aligned.motion
    shifted = clra.align(scan[0], estimate="shift", motion=start, quality=False).motion
    assert np.allclose(shifted.rotation, start.rotation, atol=1e-9)
    assert np.abs(shifted.shift_u - start.shift_u).mean() < 2 * SHIFT
    by_imgr = clra.align(scan[0], "imgr", estimate="shift", motion=start, quality=False).motion
    assert np.allclose(by_imgr.rotation, start.rotation, atol=1e-9)
    with pytest.raises(InputError, match="found a rigid one with estimate='source'"):
        clra.align(scan[0], estimate="source", motion=start)
    with pytest.raises(InputError, match="found 'rigid' with method 'imgr', expected 'ra'"):
        clra.align(scan[0], "imgr", estimate="rigid")


def test_sigma_is_the_scatter_of_what_noise_does(scan):
    """Of radiographs with white noise, against one volume."""
    stream, geometry = Stream(None), scan[1]
    images = scan[0].projections
    still = clra.Scan(images, geometry)
    grid, six = default_grid(geometry), (0, 1, 2, 3, 4, 5)
    level = RigidLevel(stream, still, grid, Solver(), 1, six, np.zeros(6))
    volume = level.reconstructed(level.radiographs, geometry, np.ones(VIEWS, np.bool_), "")
    plain = level.registered(level.radiographs, volume, geometry, "")
    errors, sigmas = [], []
    for seed in range(3):
        noise = 0.05 * images.max() * np.random.default_rng(seed).normal(size=images.shape)
        noisy = clra.Scan((images + noise).astype(np.float32), geometry)
        step = level.registered(Radiographs(stream, noisy, 1), volume, geometry, "")
        errors.append(step.table - plain.table)
        sigmas.append(step.sigma)
    ratio = np.concatenate(errors).std(axis=0) / np.sqrt(np.mean(np.square(sigmas), axis=(0, 1)))
    assert (ratio > 0.85).all() and (ratio < 1.2).all()
