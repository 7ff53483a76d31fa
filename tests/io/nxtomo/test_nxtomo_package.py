"""Files go to and fro between clra and the nxtomo package."""

from pathlib import Path

import numpy as np
import pytest

from clra.io.nxtomo.writer import write_nxtomo
from clra.io.scan_files import read_scan
from clra.model.trajectory import helix

pytest.importorskip("nxtomo")
pint = pytest.importorskip("pint")


@pytest.fixture(scope="module")
def units():
    return pint.get_application_registry()


def test_the_package_reads_what_we_write(tmp_path: Path, units) -> None:
    from nxtomo.application.nxtomo import NXtomo

    geometry = helix(
        6,
        angle_step=np.deg2rad(40.0),
        z_step=0.25,
        source_to_axis=30.0,
        source_to_detector=300.0,
        pixel_size=0.5,
        shape=(5, 7),
    )
    rng = np.random.default_rng(0)
    pixels = rng.integers(100, 900, (6, 5, 7)).astype(np.uint16)
    flats = np.full((2, 5, 7), 1000, np.uint16)
    darks = np.full((3, 5, 7), 10, np.uint16)
    path = tmp_path / "scan.nxs"
    frames, valid_views = {"flats": flats, "darks": darks}, np.arange(6) != 2
    write_nxtomo(path, pixels, geometry, **frames, valid_views=valid_views, name="helix")

    read = NXtomo().load(str(path), "entry", detector_data_as="as_numpy_array")
    NXtomo.check_consistency(read, raises_error=True)
    detector, sample = read.instrument.detector, read.sample
    np.testing.assert_array_equal([int(k.value) for k in detector.image_key_control],
                                  [2] * 3 + [1] * 2 + [0, 0, 3, 0, 0, 0])  # fmt: skip
    np.testing.assert_array_equal(detector.data[-6:], pixels[:, ::-1])
    assert read.title == "helix"
    assert detector.distance.to(units.mm).magnitude == pytest.approx(270.0)
    assert read.instrument.source.distance.to(units.mm).magnitude == pytest.approx(-30.0)
    assert detector.x_pixel_size.to(units.mm).magnitude == pytest.approx(0.5)
    angles = sample.rotation_angle.to(units.degree).magnitude[-6:]
    np.testing.assert_allclose(np.diff(angles), -40.0, atol=1e-9)
    # The source climbs along the helix: seen from the scanner, the sample sinks.
    heights = sample.z_translation.to(units.mm).magnitude[-6:]
    np.testing.assert_allclose(heights, -geometry.source[:, 2], atol=1e-12)


def test_we_read_what_the_package_writes(tmp_path: Path, units) -> None:
    from nxtomo.application.nxtomo import NXtomo

    rng = np.random.default_rng(1)
    keys = np.array([2, 1, 0, 0, 0, 0, 0, 1])
    transmission = rng.uniform(0.2, 0.9, (5, 4, 6))
    frames = np.full((8, 4, 6), 20.0)
    frames[keys == 1] = 1020.0
    frames[keys == 0] = 20 + 1000 * transmission
    angles = np.array([0.0, 0, 0, 72, 144, 216, 288, 288])
    scan = NXtomo()
    scan.title = "from the package"
    scan.instrument.detector.data = frames.astype(np.float32)
    scan.instrument.detector.image_key_control = keys
    scan.instrument.detector.x_pixel_size = 10 * units.um
    scan.instrument.detector.y_pixel_size = 10 * units.um
    scan.instrument.detector.distance = 0.4 * units.m
    scan.instrument.source.distance = -10 * units.cm
    scan.sample.rotation_angle = angles * units.degree
    scan.sample.x_translation = np.zeros(8) * units.mm
    scan.sample.z_translation = np.linspace(0, 700, 8) * units.um
    path = tmp_path / "package.nx"
    scan.save(str(path), "entry0000")

    read = read_scan(path)
    np.testing.assert_allclose(read.read(0, 5), -np.log(transmission), rtol=0, atol=1e-5)
    geometry = read.geometry
    b = -np.deg2rad(angles[keys == 0])
    heights = np.linspace(0, 0.7, 8)[keys == 0]
    source = np.stack([100 * np.sin(b), -100 * np.cos(b), -heights], axis=1)
    np.testing.assert_allclose(geometry.source, source, atol=1e-10)
    np.testing.assert_allclose(geometry.source_to_detector, 500.0)
    u = 0.01 * np.stack([np.cos(b), np.sin(b), 0 * b], axis=1)
    np.testing.assert_allclose(geometry.u, u, atol=1e-15)
    np.testing.assert_allclose(geometry.v, [[0, 0, -0.01]] * 5, atol=1e-15)
