"""Ordered-subset reconstruction of counted photons."""

import dataclasses
import functools

import numpy as np
import pytest

import clra
from clra.errors import InputError
from clra.methods.reconstruction.iterative import Multigrid
from clra.methods.reconstruction.osem_tr import OrderedSubsets, osem_tr, start_volume
from clra.model.grid import default_grid
from clra.model.phantoms.ellipsoids import porous
from clra.ops.streaming.radiographs import Radiographs
from clra.ops.streaming.slab_projector import SlabProjector, volume_from
from clra.ops.streaming.stream import Stream

PHOTONS = 1e4
# 4 x 7 x 7 voxels under 120 views of 10 x 20: small and well posed enough to converge.
SMALL = clra.circular(120, source_to_axis=5, source_to_detector=50, pixel_size=1.0, shape=(10, 20))
GRID = clra.VolumeGrid(shape=(4, 7, 7), voxel_size=0.2)


@functools.cache
def shared():
    """One device for all tests: kernels are built once."""
    return Stream()


def projected(values, geometry=SMALL, grid=GRID):
    """Line integrals of a volume, by the operator whose adjoint the method uses."""
    stream = shared()
    out = stream.empty((geometry.views, *geometry.shape))
    SlabProjector(stream, volume_from(stream, grid, values), geometry)(
        out, slice(0, geometry.views)
    )
    return stream.download(out)


@pytest.fixture(scope="module")
def box():
    values = np.zeros(GRID.shape, np.float32)
    values[:, 1:6, 1:6] = np.random.default_rng(0).uniform(0.3, 1.5, (4, 5, 5))
    return values


@pytest.fixture(scope="module")
def integrals(box):
    return projected(box)


def run(integrals, *, used=None, geometry=SMALL, grid=GRID, stream=None, **options):
    """Volume and misfits."""
    options = OrderedSubsets(**options)
    stream = stream or shared()
    radiographs = Radiographs(stream, clra.Scan(integrals, geometry), 1)
    volume = start_volume(stream, radiographs, geometry, grid, options)
    used = np.ones(geometry.shape, bool) if used is None else used
    misfits = osem_tr(stream, radiographs, geometry, volume, options, used=used)
    return volume.to_host(), misfits


def distance(one, other):
    return float(np.linalg.norm(one - other) / np.linalg.norm(other))


def counted(integrals, background=0.0, seed=1, photons=PHOTONS):
    """The same with Poisson noise, background contained."""
    random = np.random.default_rng(seed)
    counts = random.poisson(photons * np.exp(-integrals.astype(float)) + background)
    return counts


def test_all_subsets_lead_to_one_volume(box, integrals):
    volumes = [
        run(integrals, subsets=subsets, passes=passes, initial="uniform")[0]
        for subsets, passes in ((1, 160), (7, 40), (40, 8))
    ]
    for volume in volumes:
        assert distance(volume, box) < 0.01
        assert distance(volume, volumes[0]) < 0.01


@pytest.mark.parametrize("background", [0.0, 400.0])
def test_optimal_curvature_never_lowers_the_likelihood(integrals, background):
    counts = counted(integrals, background, photons=300)
    measured = -np.log(np.maximum(counts - background, 1) / 300).astype(np.float32)
    y = 300 * np.exp(-measured.astype(float)) + background
    volume, likelihoods = "uniform", []
    for _ in range(16):
        options = {"update": "optimal", "initial": volume, "i0": 300.0, "background": background}
        volume, _ = run(measured, subsets=1, passes=1, **options)
        q = 300 * np.exp(-projected(volume).astype(float)) + background
        likelihoods.append((y * np.log(q) - q).sum())
    assert (np.diff(likelihoods) > 0).all()


def test_misfit_is_near_one_where_only_noise_is_left(integrals):
    counts = counted(integrals)
    measured = -np.log(counts / PHOTONS).astype(np.float32)
    _, misfits = run(measured, passes=30, i0=PHOTONS)
    assert misfits[-1] == pytest.approx(1, abs=0.1)
    assert misfits[0] > misfits[-1]


def test_the_number_of_photons_does_not_matter_without_background(integrals):
    few, many = (run(integrals, passes=2, i0=i0)[0] for i0 in (1e2, 1e7))
    assert distance(few, many) < 1e-4


def test_background_is_allowed_for(box, integrals):
    background = 1000.0
    ratio = np.exp(-integrals.astype(float)) + background / PHOTONS
    # Measured: what the counts minus background are taken for.
    assert distance(run(-np.log(ratio).astype(np.float32), passes=20)[0], box) > 0.05
    measured = -np.log(ratio - background / PHOTONS).astype(np.float32)
    volume, _ = run(measured, passes=20, background=background, i0=PHOTONS)
    assert distance(volume, box) < 0.02


def test_masked_pixels_do_not_matter(box, integrals):
    used = np.ones(SMALL.shape, bool)
    used[4, 7] = used[:, 12] = False
    spoilt = integrals.copy()
    spoilt[:, ~used] = 7.0
    volume, _ = run(spoilt, used=used, passes=30, subsets=6, initial="uniform")
    assert distance(volume, box) < 0.03


def test_multiplicative_form_comes_near_at_first(box, integrals):
    one, misfits = run(integrals, passes=4, subsets=20, update="multiplicative", initial="uniform")
    assert distance(one, box) < 0.25
    assert misfits[-1] < 0.2 * misfits[0]
    assert (one >= 0).all()


@pytest.mark.parametrize("update", ["paraboloid", "optimal", "multiplicative"])
def test_voxels_that_no_ray_meets_keep_their_value(integrals, update):
    high = dataclasses.replace(GRID, shape=(40, 7, 7))
    given = np.full(high.shape, 0.75, np.float32)
    volume, _ = run(integrals, grid=high, passes=2, subsets=8, update=update, initial=given)
    assert np.all(volume[[0, -1]] == np.float32(0.75))
    assert not np.any(np.isclose(volume[19:21, 2:5, 2:5], 0.75, atol=1e-4).all())


@pytest.mark.parametrize("update", ["paraboloid", "multiplicative"])
def test_slabs_make_the_same_volume(integrals, update):
    stream = Stream()
    object.__setattr__(stream.budgets, "slab", 4 * 4 * 7 * 7)  # one plane of four volumes
    options = {"passes": 2, "subsets": 5, "update": update, "initial": "uniform"}
    assert (
        distance(run(integrals, stream=stream, **options)[0], run(integrals, **options)[0]) < 1e-5
    )


def test_few_views_and_empty_radiographs():
    one = SMALL.subset([3])
    volume, _ = run(np.zeros((1, 10, 20), np.float32), geometry=one)
    assert (volume == 0).all()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"update": "newton"}, "update: found 'newton', expected one of"),
        ({"initial": "zeros"}, "initial: found 'zeros', expected one of"),
        ({"initial": np.zeros((2, 2, 2))}, r"volume: found shape \(2, 2, 2\), expected"),
        ({"i0": 0.0}, "i0: found 0, expected photons"),
        ({"background": -1.0}, "background: found -1, expected photons"),
        ({"passes": 0}, "passes: found 0, expected at least 1"),
        ({"subsets": 121}, "subsets: found 121, expected at most 120"),
    ],
)
def test_bad_options_are_refused(integrals, options, message):
    with pytest.raises(ValueError, match=message):
        run(integrals, **options)


def test_noise_is_far_below_that_of_filtered_back_projection():
    geometry = clra.circular(
        240, source_to_axis=7.068, source_to_detector=335.6, pixel_size=0.139 * 32, shape=(24, 64)
    )
    grid = default_grid(geometry)
    rock = porous(0.42 * 64 * grid.voxel_size, 12 * grid.voxel_size, seed=3, count=150)
    line_integrals = rock.line_integrals(geometry, oversample=2)
    scale = 2 / line_integrals.max()
    counts = counted(line_integrals * scale)
    measured = np.log(PHOTONS / np.maximum(counts, 0.5)).astype(np.float32)
    truth = rock.volume(grid, oversample=3) * scale
    scan = clra.Scan(measured, geometry)
    fbp = clra.reconstruct(scan)
    # From the mean attenuation; the public face adds a margin, which nothing here fills.
    iterative = clra.reconstruct(
        scan,
        method="osem-tr",
        options=OrderedSubsets(subsets=40, passes=3, initial="uniform", i0=PHOTONS),
    )
    assert distance(iterative, truth) < 0.75 * distance(fbp, truth)


def test_options_of_other_methods_are_refused(integrals):
    scan = clra.Scan(integrals, SMALL)
    with pytest.raises(InputError, match=r"options: found OrderedSubsets with fbp, expected none"):
        clra.reconstruct(scan, options=OrderedSubsets(subsets=4))
    with pytest.raises(InputError, match=r"found Multigrid with osem-tr, expected OrderedSubsets"):
        clra.reconstruct(scan, method="osem-tr", options=Multigrid(levels="QR-HR-FR"))
