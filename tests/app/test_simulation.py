import numpy as np
import pytest

from clra.app.simulation import (
    MOTIONS,
    PHANTOMS,
    TRAJECTORIES,
    paper_like,
    sample,
    simulated_motion,
    simulated_scan,
)
from clra.model import trajectory
from clra.model.gauge.gauge import Gauge, sample_points
from clra.model.grid import default_grid
from clra.model.motion import Motion

SHAPE = (41, 33)
SHIFT = (-10.0, 8.0)


def test_a_detector_of_the_papers_size_gives_the_papers_geometry():
    paper = trajectory.PAPER
    assert paper_like("helix", 3456, paper["shape"]) == trajectory.helix(
        3456, angle_step=np.radians(0.5), **paper
    )
    assert paper_like("space-filling", 3456, paper["shape"]) == trajectory.space_filling(
        3456, **paper
    )


@pytest.mark.parametrize("kind", TRAJECTORIES)
@pytest.mark.parametrize("phantom", PHANTOMS)
def test_the_sample_is_seen_whole_from_the_side(kind, phantom):
    geometry = paper_like(kind, 12, SHAPE)
    scan = simulated_scan(geometry, sample(phantom, geometry), Motion.identity(12))
    radiographs = scan.read(0, 12)
    assert radiographs.max() > 0.5
    assert radiographs[:, :, [0, -1]].max() == 0
    if kind == "circular":
        assert radiographs[:, [0, -1]].max() == 0


@pytest.mark.parametrize("kind", MOTIONS)
def test_motions_keep_about_their_range_and_have_no_gauge(kind):
    geometry = paper_like("helix", 60, SHAPE)
    motion = simulated_motion(kind, geometry, shift=SHIFT, magnification=0.001, seed=3)
    assert np.abs(motion.shift_u).max() < 1.5 * 10
    assert (kind == "none") == (motion == Motion.identity(60))
    fit = Gauge(geometry, sample_points(default_grid(geometry))).fit(motion)
    kept = simulated_motion(
        kind, geometry, shift=SHIFT, magnification=0.001, seed=3, keep_gauge=True
    )
    fit_of_kept = Gauge(geometry, sample_points(default_grid(geometry))).fit(kept)
    if kind != "none":
        assert np.abs(fit.part[:, :2]).max() < 0.05 * np.abs(fit_of_kept.part[:, :2]).max()


def test_radiographs_are_those_of_the_moved_geometry_and_noise_does_not_depend_on_reading():
    geometry = paper_like("space-filling", 11, SHAPE)
    phantom = sample("spheres", geometry)
    truth = simulated_motion("both", geometry, shift=SHIFT, seed=1)
    clean = simulated_scan(geometry, phantom, truth)
    expected = phantom.line_integrals(geometry.with_motion(truth))
    np.testing.assert_array_equal(clean.read(0, 11), expected)
    assert clean.truth == truth and clean.geometry == geometry
    noisy = simulated_scan(geometry, phantom, truth, noise=1000, seed=5)
    whole = noisy.read(0, 11)
    np.testing.assert_array_equal(whole[4:7], noisy.read(4, 7))
    air = expected == 0
    assert whole[air].std() == pytest.approx(1000**-0.5, rel=0.05)


@pytest.mark.parametrize(
    ("call", "found"),
    [
        (lambda g, p: paper_like("spiral", 12, SHAPE), "'spiral'"),
        (lambda g, p: paper_like("double-helix", 13, SHAPE), "13"),
        (lambda g, p: sample("teapot", g), "'teapot'"),
        (lambda g, p: simulated_motion("wild", g, shift=SHIFT), "'wild'"),
        (lambda g, p: simulated_scan(g, p, Motion.identity(12), noise=0), "0 photons"),
    ],
)
def test_unknown_wishes_are_refused(call, found):
    geometry = paper_like("circular", 12, SHAPE)
    with pytest.raises(ValueError, match=found):
        call(geometry, sample("spheres", geometry))
