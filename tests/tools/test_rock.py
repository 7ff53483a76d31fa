import numpy as np
import pytest

import clra
from clra.model.phantoms.ellipsoids import Ellipsoids
from clra.model.phantoms.perturbation import random_motion

BALL = Ellipsoids([[0.1, -0.2, 0.05]], [0.45], [1.0])


@pytest.fixture
def rock(tool):
    return tool("rock")


@pytest.fixture
def moved(rock):
    geometry = rock.geometry_of("helix", 8).subset(slice(150, 153))
    motion = random_motion(3, seed=1, shift=(-3, 2), magnification=0.01)
    return geometry, motion


def test_pixels_cut_up_are_on_the_same_rays(rock, moved):
    geometry, motion = moved
    fine = rock.split(geometry, motion, 2)
    points = np.random.default_rng(0).uniform(-0.3, 0.3, (4, 3))
    pixels = (fine.project(points) - 0.5) / 2  # means of two
    np.testing.assert_allclose(pixels, geometry.with_motion(motion).project(points), atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(fine.u, axis=1), 0.4544 * 4, rtol=1e-12)


def test_itk_rtk_projects_what_moved(rock, moved):
    pytest.importorskip("itk")
    geometry, motion = moved
    grid = clra.VolumeGrid(shape=(100, 100, 100), voxel_size=0.014)
    found = rock.Rtk().forward(rock.split(geometry, motion, 1), grid, BALL.volume(grid))()()
    expected = BALL.line_integrals(geometry.with_motion(motion))
    assert np.std(found - expected) < 0.004 * expected.max()
    at_rest = BALL.line_integrals(geometry)
    assert np.std(found - at_rest) > 0.04 * expected.max()


def test_photons_are_those_of_the_view(rock):
    images = np.random.default_rng(0).uniform(0, 2, (5, 300, 200)).astype(np.float32)
    counted = rock.Counted(images)
    found = counted[0:5]
    np.testing.assert_array_equal(counted[2:4], found[2:4])
    # Of n photons the logarithm is off by 1 / sqrt(n), and on average by 1 / (2 n).
    photons = rock.PHOTONS * np.exp(-images)
    deviation = (found - images) * np.sqrt(photons)
    assert abs(deviation.mean()) < 0.02
    assert abs(deviation.std() - 1) < 0.01
    assert abs(np.corrcoef(deviation.reshape(5, -1))[0, 1]) < 0.02


def test_rock_fills_the_cylinder(rock, data, monkeypatch):
    monkeypatch.setenv("CLRA_TEST_DATA", str(data))
    grid = rock.cylinder(4, "berea")
    grains = rock.berea(grid)
    assert grains.shape == grid.shape == (624, 240, 240)
    # A fifth of the sandstone is pores.
    assert grains.sum() / (np.pi * (0.97 * 120) ** 2 * 624) == pytest.approx(0.8, abs=0.02)
    fine = rock.cylinder(4, "fine berea")
    assert fine.shape == (1248, 480, 480) and fine.voxel_size == grid.voxel_size / 2


def test_data_that_are_not_there(rock, monkeypatch, tmp_path):
    monkeypatch.setenv("CLRA_TEST_DATA", str(tmp_path))
    with pytest.raises(SystemExit, match=r"found no .*berea_200\.npz, expected a folder"):
        rock.berea(rock.cylinder(4, "berea"))
