from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from geometries import upside_down

from clra.errors import InputError
from clra.io.motion_formats.rtk import read_rtk_geometry, write_rtk_geometry
from clra.model.geometry import ConeBeamGeometry
from clra.model.trajectory import helix

DETECTOR = {"shape": (5, 6), "pixel_size": 0.5}
# Of a scanner of 300 mm, in mm and in pixels of half a mm.
ROUNDING = 1e-10


def turned(vectors: np.ndarray, angles: np.ndarray) -> np.ndarray:
    """Vectors turned about x, y and z."""
    c, s = np.cos(angles), np.sin(angles)
    about_x = np.array([[1, 0, 0], [0, c[0], -s[0]], [0, s[0], c[0]]])
    about_y = np.array([[c[1], 0, s[1]], [0, 1, 0], [-s[1], 0, c[1]]])
    about_z = np.array([[c[2], -s[2], 0], [s[2], c[2], 0], [0, 0, 1]])
    return vectors @ (about_z @ about_y @ about_x).T


@pytest.fixture
def tilted() -> ConeBeamGeometry:
    """A helix whose sources and detectors stand anyhow, each detector turned by some degrees."""
    rng = np.random.default_rng(0)
    ideal = helix(
        7, angle_step=0.6, z_step=0.1, source_to_axis=30, source_to_detector=300, **DETECTOR
    )
    tilts = 0.1 * rng.normal(size=(7, 3))
    return ConeBeamGeometry(
        source=ideal.source + rng.normal(size=(7, 3)),
        detector=ideal.detector + rng.normal(size=(7, 3)),
        u=[turned(u, a) for u, a in zip(ideal.u, tilts, strict=True)],
        v=[turned(v, a) for v, a in zip(ideal.v, tilts, strict=True)],
        shape=ideal.shape,
    )


def rtk_pixels(path: Path, points: np.ndarray) -> np.ndarray:
    """Pixels by the matrices in the file: points in RTK's axes to mm from the detector's middle."""
    seen = np.stack([points[:, 0], points[:, 2], -points[:, 1], np.ones(len(points))])
    found = []
    for element in ElementTree.parse(path).iter("Matrix"):
        column, row, depth = np.array(element.text.split(), float).reshape(3, 4) @ seen
        found.append(np.stack([column / depth / 0.5 + 2.5, row / depth / 0.5 + 2.0], axis=1))
    return np.array(found)


def test_geometry_survives(tmp_path: Path, tilted: ConeBeamGeometry) -> None:
    path = tmp_path / "geometry.xml"
    write_rtk_geometry(path, tilted)
    read = read_rtk_geometry(path, **DETECTOR)
    np.testing.assert_allclose(read.to_astra(), tilted.to_astra(), rtol=0, atol=ROUNDING)


def test_matrices_project_as_the_geometry(tmp_path: Path, tilted: ConeBeamGeometry) -> None:
    path = tmp_path / "geometry.xml"
    write_rtk_geometry(path, tilted)
    points = np.random.default_rng(1).normal(size=(4, 3))
    np.testing.assert_allclose(
        rtk_pixels(path, points), tilted.project(points), rtol=0, atol=100 * ROUNDING
    )


def test_rows_from_the_top_are_the_same_detector(tmp_path: Path, tilted: ConeBeamGeometry) -> None:
    down = upside_down(tilted)
    one, two = tmp_path / "one.xml", tmp_path / "two.xml"
    write_rtk_geometry(one, tilted)
    write_rtk_geometry(two, down)
    assert one.read_text() == two.read_text()
    read = read_rtk_geometry(two, **DETECTOR, top_down=True)
    np.testing.assert_allclose(read.to_astra(), down.to_astra(), rtol=0, atol=ROUNDING)


def test_skewed_detectors_are_refused(tmp_path: Path, tilted: ConeBeamGeometry) -> None:
    skewed = ConeBeamGeometry(
        source=tilted.source,
        detector=tilted.detector,
        u=tilted.u,
        v=tilted.v + np.array([[0, 0, 0]] * 3 + [[1e-4, 0, 0]] + [[0, 0, 0]] * 3),
        shape=tilted.shape,
    )
    with pytest.raises(ValueError, match="degrees apart in view 3, expected 90"):
        write_rtk_geometry(tmp_path / "geometry.xml", skewed)
    assert not list(tmp_path.iterdir())


def test_what_is_no_geometry(tmp_path: Path) -> None:
    path = tmp_path / "geometry.xml"
    for text, message in {
        "not at all": "cannot be read as RTK's XML",
        "<Other/>": "found <Other> with 0 projections",
        "<RTKThreeDCircularGeometry/>": "with 0 projections, expected",
        "<RTKThreeDCircularGeometry><Projection><GantryAngle>x</GantryAngle></Projection>"
        "</RTKThreeDCircularGeometry>": "GantryAngle: found 'x', expected a number",
        "<RTKThreeDCircularGeometry><RadiusCylindricalDetector>5</RadiusCylindricalDetector>"
        "<Projection/></RTKThreeDCircularGeometry>": "expected 0: a flat detector",
    }.items():
        path.write_text(text)
        with pytest.raises(InputError, match=message):
            read_rtk_geometry(path, **DETECTOR)
    with pytest.raises(InputError, match="No such file"):
        read_rtk_geometry(tmp_path / "none.xml", **DETECTOR)


def test_file_written_by_rtk(data: Path, tmp_path: Path) -> None:
    path = data / "rtk_geometry_written_by_itk_rtk.xml"
    geometry = read_rtk_geometry(path, **DETECTOR)
    points = np.random.default_rng(2).normal(size=(4, 3))
    expected = rtk_pixels(path, points)
    np.testing.assert_allclose(geometry.project(points), expected, rtol=0, atol=1e-8)
    ours = tmp_path / "ours.xml"
    write_rtk_geometry(ours, geometry)
    np.testing.assert_allclose(rtk_pixels(ours, points), expected, rtol=0, atol=1e-8)
