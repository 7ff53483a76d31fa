"""Multigrid reconstruction with alignment inside: Algorithm 3 on a small scan with known motion."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

import clra
from clra.methods.reconstruction.imgr import imgr
from clra.methods.reconstruction.imgr_state import ReconstructionInterrupted
from clra.methods.reconstruction.iterative import Multigrid
from clra.methods.reconstruction.osem_tr import OrderedSubsets
from clra.methods.reconstruction.residuals import between, residuals
from clra.model.gauge.gauge import sample_points, without_gauge
from clra.model.grid import default_grid
from clra.model.phantoms.ellipsoids import porous
from clra.model.phantoms.perturbation import random_motion, smooth_motion
from clra.model.view_selection import sampled
from clra.ops.streaming.memory import Store
from clra.ops.streaming.radiographs import Radiographs
from clra.ops.streaming.slab_projector import SlabProjector, volume_from
from clra.ops.streaming.stream import Stream

# The scan of the paper's section 3.2 at a twenty-fourth of its resolution.
VIEWS, COLUMNS = 160, 96
PIXEL = 0.139 * 2304 / COLUMNS
VOXEL = PIXEL * 7.068 / 335.6
PHOTONS = 1e4


@pytest.fixture(scope="module")
def geometry():
    return clra.space_filling(
        VIEWS,
        z_step=0.7 * COLUMNS * VOXEL / VIEWS,
        source_to_axis=7.068,
        source_to_detector=335.6,
        pixel_size=PIXEL,
        shape=(COLUMNS, COLUMNS + 1),
    )


@pytest.fixture(scope="module")
def truth(geometry):
    motion = random_motion(VIEWS, seed=0, shift=(-1, 1), magnification=5e-4).then(
        smooth_motion(VIEWS, seed=1, shift=(-1, 1), magnification=5e-4)
    )
    halved = clra.Motion(
        shift_u=motion.shift_u, shift_v=motion.shift_v / 2, magnification=motion.magnification
    )
    return without_gauge(halved, geometry, [sample_points(default_grid(geometry))], True)


@pytest.fixture(scope="module")
def grid(geometry):
    return default_grid(geometry)


@pytest.fixture(scope="module")
def rock(grid):
    nz, _, nx = grid.shape
    return porous(0.38 * nx * grid.voxel_size, 0.9 * nz * grid.voxel_size, seed=1, count=250)


@pytest.fixture(scope="module")
def moved(geometry, truth, rock):
    integrals = rock.line_integrals(geometry.with_motion(truth))
    integrals *= 2 / integrals.max()
    counts = np.random.default_rng(2).poisson(PHOTONS * np.exp(-integrals.astype(float)))
    measured = np.log(PHOTONS / np.maximum(counts, 0.5)).astype(np.float32)
    return clra.Scan(measured, geometry, truth=truth), 2 / rock.line_integrals(geometry).max()


@pytest.fixture(scope="module")
def scan(moved):
    return moved[0]


@pytest.fixture(scope="module")
def error(rock, grid, moved):
    attenuation = rock.volume(grid, oversample=3) * moved[1]
    x, y, _ = grid.coordinates()
    inside = np.hypot(*np.meshgrid(x, y)) < 0.46 * grid.shape[2] * grid.voxel_size

    def relative(volume):
        lack = (volume - attenuation)[:, inside]
        return float(np.linalg.norm(lack) / np.linalg.norm(attenuation[:, inside]))

    return relative


@pytest.fixture(scope="module")
def stream():
    return Stream()


@pytest.fixture(scope="module")
def aligned(scan):
    return clra.align(scan, method="imgr")


def test_motion_is_found_on_the_way(aligned):
    last = aligned.history[-1]
    assert last.level == "FR"
    assert last.mae_u < 0.1
    assert last.mae_v < 0.1
    assert [(i.iteration, i.level) for i in aligned.history[:3]] == [
        (1, "QR"), (1, "HR"), (1, "FR"),
    ]  # fmt: skip
    misfits = [i.misfit for i in aligned.history if i.iteration == 1]
    assert misfits == sorted(misfits, reverse=True)
    assert aligned.schedule == "QR-HR-FR"
    assert (aligned.confidence > 0.9).all()


def test_volume_is_as_good_as_with_the_true_motion(scan, truth, aligned, error):
    without = error(clra.reconstruct(scan, method="imgr", options=Multigrid(i0=PHOTONS)))
    known = error(
        clra.reconstruct(scan, method="imgr", motion=truth, options=Multigrid(i0=PHOTONS))
    )
    assert error(aligned.volume) < 1.1 * known
    assert known < 0.75 * without


def test_noise_and_few_views_are_taken_better_than_by_filtered_back_projection(scan, truth, error):
    for views in (slice(None), slice(None, None, 4)):
        some, motion = scan.subset(views), truth.subset(views)
        grid = default_grid(scan.geometry)
        options = {"grid": grid, "motion": motion}
        fbp = np.maximum(clra.reconstruct(some, **options), 0)
        assert error(clra.reconstruct(some, method="imgr", **options)) < 0.9 * error(fbp)


def test_an_interrupted_run_goes_on_as_if_it_had_not_been(scan, grid, stream, monkeypatch):
    monkeypatch.setattr("clra.methods.reconstruction.imgr.converged", lambda *updates: False)

    def run(reports, state=None):
        count = [0]

        def report(progress):
            if "misfit" in progress.stage:
                count[0] += 1
            elif count[0] == reports:
                raise KeyboardInterrupt

        stream._report = report
        try:
            return imgr(stream, scan, grid, align=True, cycles=2, state=state)
        finally:
            stream._report = None

    whole = run(-1)
    assert len(whole.steps) == 6
    for level, name in enumerate(["QR", "HR", "FR", "QR"], 1):
        with pytest.raises(ReconstructionInterrupted) as stopped:
            run(level)
        state = stopped.value.state
        assert [step.level for step in state.steps][-1] == name
        assert stopped.value.alignment.history[-1].level == name
        assert state.volume.grid.voxel_size == pytest.approx(
            VOXEL * {"QR": 4, "HR": 2, "FR": 1}[name], rel=0.01
        )
    again = run(-1, state)
    np.testing.assert_array_equal(again.volume.to_host(), whole.volume.to_host())
    np.testing.assert_array_equal(again.motion.shift_u, whole.motion.shift_u)
    np.testing.assert_array_equal(again.motion.magnification, whole.motion.magnification)
    assert [s.misfit for s in again.steps] == [s.misfit for s in whole.steps]


def test_ctrl_c_before_the_first_level_keeps_nothing(scan, grid):
    def report(progress):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt) as stopped:
        imgr(Stream(report=report), scan, grid)
    assert not isinstance(stopped.value, ReconstructionInterrupted)


def other(motion):
    return clra.Motion(
        shift_u=0.5 * motion.shift_v,
        shift_v=motion.shift_u,
        magnification=motion.magnification[::-1],
    )


@pytest.mark.parametrize("level", [1, 2, 4, 8])
def test_features_move_from_one_motion_to_another(geometry, truth, level):
    points = np.random.default_rng(4).uniform(-1, 1, (20, 3))
    before, after = (
        geometry.with_motion(motion).binned(level).project(points)
        for motion in (other(truth), truth)
    )
    step = between(other(truth), truth, geometry.shape, level)[:, None]
    rows, columns = (n // level for n in geometry.shape)
    centre = np.array([columns - 1, rows - 1]) / 2
    expected = centre + step[..., 2:] * (before - centre) + step[..., :2]
    np.testing.assert_allclose(after, expected, rtol=0, atol=1e-9)


def test_simulated_radiographs_follow_the_motion(rock, geometry, truth, grid, stream):
    """Resampled, they are what a projection with the detector moved gives."""
    # Edges as sharp as voxels no interpolation follows; volumes prolongated have none.
    volume = volume_from(stream, grid, gaussian_filter(rock.volume(grid), 1.5))

    def simulated(motion):
        out = stream.empty((VIEWS, *geometry.shape))
        SlabProjector(stream, volume, geometry.with_motion(motion))(out, slice(0, VIEWS))
        return stream.download(out)

    goal = simulated(truth)
    kept = Store(goal.shape, stream.room)
    kept.write(0, simulated(other(truth)))
    apart = float(np.sqrt(np.mean((goal - kept.read(0, VIEWS)) ** 2)))
    left = residuals(
        stream,
        Radiographs(stream, clra.Scan(goal, geometry), 1),
        kept,
        np.ones(geometry.shape, bool),
        moved=between(other(truth), truth, geometry.shape, 1),
    )
    assert np.sqrt(np.mean(left.read(slice(0, VIEWS)) ** 2)) < 0.03 * apart


def test_less_memory_than_the_volume_makes_the_same_volume(scan, grid):
    some = scan.subset(slice(None, None, 8))
    size = 4 * int(np.prod(grid.shape))
    free = clra.reconstruct(some, method="imgr", grid=grid, options=Multigrid(subsets=3))
    tight = clra.reconstruct(
        some,
        method="imgr",
        grid=grid,
        options=Multigrid(subsets=3),
        max_device_memory=size // 4,
        max_host_memory=size // 2,
    )
    assert np.linalg.norm(tight - free) < 1e-5 * np.linalg.norm(free)


def test_few_views_are_valid_views_less(geometry, grid):
    assert sampled(geometry, grid) == 1
    few = geometry.subset(slice(None, None, 16))
    assert sampled(few, grid) == pytest.approx(sampled(few, grid.binned(2)) / 2, rel=0.1)
    assert sampled(few, grid) < 0.2


def test_bad_options_are_refused(scan, grid, stream):
    with pytest.raises(ValueError, match=r"levels: found 'QR-FR', expected resolutions"):
        imgr(stream, scan, grid, levels="QR-FR")
    with pytest.raises(ValueError, match=r"levels: found '1QR-1HR', expected resolutions"):
        clra.align(scan, method="imgr", schedule="1QR-1HR")
    with pytest.raises(ValueError, match="initial: found a volume"):
        imgr(stream, scan, grid, osem=OrderedSubsets(initial=np.zeros(grid.shape)))
    with pytest.raises(ValueError, match="found 1 view, expected at least 2"):
        imgr(stream, scan.subset([0]), grid, align=True)
