"""Exact reconstruction against phantoms whose radiographs are closed forms."""

import math

import h5py
import numpy as np
import pytest
from scipy import ndimage

import clra
from clra.io.scan_files import write_scan
from clra.methods.reconstruction.katsevich import katsevich
from clra.model.geometry import ConeBeamGeometry
from clra.model.grid import VolumeGrid
from clra.model.helix.fit import fit_helices
from clra.model.phantoms.ellipsoids import Ellipsoids, three_spheres
from clra.ops.streaming.radiographs import Radiographs
from clra.ops.streaming.stream import Stream

MEAN, RMS = 1e-3, 6e-3  # of the phantom's 1/mm, in flat regions
BETTER = 5  # times smaller rms than ramp-FBP's
PATTERN = 5e-4  # of the largest attenuation: half of what 20000 photons a pixel leave in a ring
SAME = 1e-5  # of the largest magnitude

R, D, FIELD = 3.0, 6.0, 1.05  # mm
SMALL = VolumeGrid(shape=(48, 48, 48), voxel_size=2.0 / 48)
BODY = Ellipsoids(
    [[0, 0, 0], [0.3, 0.2, 0.05], [-0.35, -0.1, -0.1], [0, -0.5, 0.1]],
    [[0.85, 0.8, 0.85], [0.25, 0.2, 0.3], [0.2, 0.25, 0.2], [0.15, 0.15, 0.2]],
    [1.0, 0.5, -0.6, 1.0],
)


def detector_of(pitch: float, columns: int) -> dict:
    """A detector as tall as the pitch needs."""
    tangent = math.tan(math.asin(FIELD / R))
    pixel = 2 * D * tangent / columns
    top = pitch / (2 * math.pi * R) * (1 + tangent**2) * (math.pi / 2 + math.atan(tangent)) * D
    shape = (2 * math.ceil(top / pixel + 1) + 1, columns)
    return {"source_to_axis": R, "source_to_detector": D, "pixel_size": pixel, "shape": shape}


def helix_of(pitch=1.0, columns=91, views_a_turn=120, height=1.8, start=0.3, sense=1, **changes):
    views = int((height / pitch + 1.3) * views_a_turn) + 1
    step = 2 * math.pi / views_a_turn
    detector = detector_of(pitch, columns) | changes
    z_step = sense * pitch / views_a_turn
    return clra.helix(views, angle_step=step, z_step=z_step, start=start, **detector)


def other(geometry: ConeBeamGeometry, **changes) -> ConeBeamGeometry:
    vectors = {name: getattr(geometry, name) for name in ("source", "detector", "u", "v", "shape")}
    return ConeBeamGeometry(**(vectors | changes))


def flat_errors(volume, phantom, grid):
    """Relative error of the mean, and rms error, where the phantom is flat."""
    truth = phantom.volume(grid)
    flat = (ndimage.maximum_filter(truth, 7) - ndimage.minimum_filter(truth, 7) < 1e-6) & (
        truth > 0
    )
    assert flat.sum() > 300
    error = volume[flat] - truth[flat]
    return error.mean() / truth[flat].mean(), np.sqrt(np.mean(error**2)) / truth.max()


def patterns(volume, phantom, grid, pitch):
    """Largest mean error of a ring about the axis, and of a phase of the helix, where flat."""
    truth = phantom.volume(grid)
    flat = (ndimage.maximum_filter(truth, 7) - ndimage.minimum_filter(truth, 7) < 1e-6) & (
        truth > 0
    )
    x, y, z = grid.coordinates()
    ring = (np.hypot(x, y[:, None]) / grid.voxel_size).astype(int) + 0 * z[:, None, None].astype(
        int
    )
    phase = (12 * (z / pitch % 1)).astype(int)[:, None, None] + 0 * ring
    error = (volume - truth)[flat] / truth.max()
    for part in (ring[flat], phase[flat]):
        count = np.bincount(part)
        means = np.bincount(part, error)[count > 300] / count[count > 300]
        yield np.abs(means - means.mean()).max()


@pytest.mark.parametrize(("pitch", "half_cone"), [(1.0, 7), (3.0, 21)])
def test_accuracy_and_what_ramp_fbp_gives(pitch, half_cone):
    geometry = helix_of(pitch, 121, 160)
    tallest = 0.5 * geometry.rows * np.linalg.norm(geometry.v[0])
    assert math.degrees(math.atan(tallest / D)) == pytest.approx(half_cone, abs=2)
    grid = VolumeGrid(shape=(60, 60, 60), voxel_size=2.0 / 60)
    scan = clra.Scan(BODY.line_integrals(geometry), geometry)
    exact, ramp = (
        clra.reconstruct(scan, method="katsevich", grid=grid),
        clra.reconstruct(scan, grid=grid),
    )
    mean, rms = flat_errors(exact, BODY, grid)
    _, ramp_rms = flat_errors(ramp, BODY, grid)
    assert abs(mean) < MEAN and rms < RMS
    assert rms < ramp_rms / BETTER
    assert max(patterns(exact, BODY, grid, pitch)) < PATTERN
    assert max(patterns(ramp, BODY, grid, pitch)) > 10 * PATTERN


def test_three_spheres():
    spheres = three_spheres(1.0, 6.0)
    geometry = helix_of(3.0, height=2.4)
    grid = VolumeGrid(shape=(48, 48, 48), voxel_size=2.0 / 48)
    scan = clra.Scan(spheres.line_integrals(geometry), geometry)
    mean, rms = flat_errors(clra.reconstruct(scan, method="katsevich", grid=grid), spheres, grid)
    assert abs(mean) < MEAN and rms < RMS


def _all_kinds():
    up, down = helix_of(), helix_of(sense=-1, start=2.0)
    mirror = np.array([-1, 1, 1])
    return {
        "down": down,
        "backwards": other(
            up, source=up.source * mirror, detector=up.detector * mirror, u=-up.u * mirror
        ),
        "flipped": other(up, u=-up.u, v=-up.v),
        "off centre": other(
            up,
            detector=up.detector + 5.3 * up.u - 3.7 * up.v,
            shape=(up.rows + 9, up.columns + 12),
        ),
        "tall pixels": other(up, v=1.6 * up.v),
    }


@pytest.mark.parametrize(("kind", "geometry"), _all_kinds().items())
def test_any_hand_sense_and_detector(kind, geometry):
    scan = clra.Scan(BODY.line_integrals(geometry), geometry)
    volume = clra.reconstruct(scan, method="katsevich", grid=SMALL)
    mean, rms = flat_errors(volume, BODY, SMALL)
    assert abs(mean) < MEAN and rms < RMS


@pytest.mark.parametrize("seed", range(4))
def test_any_pitch_start_and_size(seed):
    random = np.random.default_rng(seed)
    columns = int(random.integers(80, 100))
    upright = helix_of(
        pitch=random.uniform(0.7, 1.6),
        columns=columns,
        sense=random.choice([-1, 1]),
        start=random.uniform(-7, 7),
    )
    wider = random.integers(0, 12, 2)  # rows and columns that one side of the detector has more
    off = random.uniform(-0.5, 0.5, 2) * wider
    geometry = other(
        upright,
        detector=upright.detector + off[0] * upright.v + off[1] * upright.u,
        shape=(upright.rows + int(wider[0]), columns + int(wider[1])),
    )
    scan = clra.Scan(BODY.line_integrals(geometry), geometry)
    volume = clra.reconstruct(scan, method="katsevich", grid=SMALL)
    mean, rms = flat_errors(volume, BODY, SMALL)
    assert abs(mean) < MEAN and rms < RMS


@pytest.mark.parametrize("second", ["half-turn", "return"])
def test_double_helix_from_a_file(second, tmp_path):
    """Read as one scan, whose angles and heights are NXtomo's fields: no vectors of ours."""
    single = helix_of()
    geometry = clra.double_helix(
        single.views,
        angle_step=2 * math.pi / 120,
        z_step=1.0 / 120,
        second=second,
        **detector_of(1.0, 91),
    )
    scan = clra.Scan(BODY.line_integrals(geometry), geometry)
    write_scan(tmp_path / "double.nxs", scan)
    with h5py.File(tmp_path / "double.nxs", "r+") as file:
        del file["entry/clra"]
    read = clra.read_scan(tmp_path / "double.nxs")
    assert [views for views, _ in fit_helices(read.geometry)] == [
        slice(0, single.views),
        slice(single.views, 2 * single.views),
    ]
    volume = clra.reconstruct(read, method="katsevich", grid=SMALL)
    mean, rms = flat_errors(volume, BODY, SMALL)
    assert abs(mean) < MEAN and rms < RMS
    # More than the first helix alone, which leaves out what the second holds of the ends.
    one = clra.reconstruct(scan.subset(slice(0, single.views)), method="katsevich", grid=SMALL)
    assert np.count_nonzero(volume) >= np.count_nonzero(one)


def test_heights_that_only_one_helix_holds():
    tall = Ellipsoids([[0, 0, 0.4], [0.3, 0.2, 0.5]], [[0.8, 0.8, 1.7], [0.25, 0.2, 0.3]], [1, 0.5])
    first = helix_of(height=0.9)
    second = helix_of(height=0.9, sense=-1, start=1.0)
    raise_by = np.array([0, 0, 0.7])
    both = [
        np.concatenate([getattr(first, name), getattr(second, name) + offset])
        for name, offset in (("source", raise_by), ("detector", raise_by), ("u", 0), ("v", 0))
    ]
    geometry = ConeBeamGeometry(
        source=both[0], detector=both[1], u=both[2], v=both[3], shape=first.shape
    )
    grid = VolumeGrid(shape=(42, 48, 48), voxel_size=2.0 / 48, centre=(0, 0, 0.35))
    volumes = [
        clra.reconstruct(clra.Scan(tall.line_integrals(one), one), method="katsevich", grid=grid)
        for one in (geometry, first)
    ]
    held = [np.count_nonzero(volume) for volume in volumes]
    assert held[0] > 1.25 * held[1]
    mean, rms = flat_errors(volumes[0], tall, grid)
    assert abs(mean) < MEAN and rms < RMS


def test_slabs_and_chunks_change_nothing():
    geometry = helix_of()
    scan = clra.Scan(BODY.line_integrals(geometry), geometry)
    grid = VolumeGrid(shape=(53, 40, 42), voxel_size=0.05, centre=(0.01, -0.02, 0.1))
    whole = clra.reconstruct(scan, method="katsevich", grid=grid)
    stream = Stream(max_device_memory=400 << 10)
    volume = katsevich(stream, Radiographs(stream, scan, 1), geometry, grid)
    assert len(volume.slabs) >= 3
    assert np.abs(volume.to_host() - whole).max() < SAME * np.abs(whole).max()


def test_the_unit_of_length_is_free():
    volumes = []
    for unit in (1.0, 1000.0):
        mm = helix_of(columns=61, views_a_turn=90)
        geometry = ConeBeamGeometry.from_astra(mm.to_astra() * unit, mm.shape)
        scan = clra.Scan(BODY.scaled(unit).line_integrals(geometry), geometry)
        grid = VolumeGrid(shape=(21, 20, 20), voxel_size=0.1 * unit)
        volumes.append(unit * clra.reconstruct(scan, method="katsevich", grid=grid))
    assert np.abs(volumes[1] - volumes[0]).max() < 10 * SAME * np.abs(volumes[0]).max()


def test_motion_is_corrected_first():
    geometry = helix_of()
    rng = np.random.default_rng(3)
    motion = clra.Motion(
        shift_u=rng.uniform(-2, 2, geometry.views),
        shift_v=rng.uniform(-0.5, 0.5, geometry.views),
        magnification=rng.uniform(0.995, 1.005, geometry.views),
    )
    moved = clra.Scan(BODY.line_integrals(geometry.with_motion(motion), oversample=2), geometry)
    still = clra.Scan(BODY.line_integrals(geometry, oversample=2), geometry)
    options = {"method": "katsevich", "grid": SMALL}
    expected = clra.reconstruct(still, **options)

    def rms(volume):
        return np.sqrt(np.mean((volume - expected) ** 2))

    corrected = rms(clra.reconstruct(moved, motion=motion, **options))
    assert corrected < 0.25 * rms(clra.reconstruct(moved, **options))


def _refused(geometry, phantom=BODY, grid=SMALL, **options):
    scan = clra.Scan(phantom.line_integrals(geometry), geometry)
    with pytest.raises(ValueError) as caught:
        clra.reconstruct(scan, method="katsevich", grid=grid, **options)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_what_katsevich_cannot_treat():
    short = helix_of(shape=(25, 91))
    for options in ({}, {"align": True}):  # before the long work
        message = _refused(short, **options)
        assert "Tam-Danielsson" in message and "pitch of at most" in message
        assert "expected rows" in message and "field of view of at most" in message
    detector = detector_of(1.0, 91)
    assert "expected a helix" in _refused(clra.circular(30, **detector))
    assert "at most 6" in _refused(clra.space_filling(90, z_step=0.01, **detector))
    wide = Ellipsoids([[0, 0, 0]], [[1.4, 1.4, 0.9]], [1.0])
    message = _refused(helix_of(), wide)
    assert "beyond the field of view of 2.1 mm" in message
    assert float(message.split("about ")[1].split(" mm")[0]) == pytest.approx(2.8, abs=0.4)
    aside = Ellipsoids([[0.4, 0, 0]], [[0.9, 0.9, 0.9]], [1.0])
    assert "beyond the field of view" in _refused(helix_of(), aside)
    high = VolumeGrid(shape=(4, 20, 20), voxel_size=0.1, centre=(0, 0, 1.6))
    assert "holds no pi-interval" in _refused(helix_of(), grid=high)
