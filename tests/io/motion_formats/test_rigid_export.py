"""Points of a sample that moved and turned are seen where each program puts them."""

from pathlib import Path

import numpy as np
import pytest
from geometries import geometry_of_cil, upside_down
from scipy.spatial.transform import Rotation

from clra.errors import InputError
from clra.io.motion_formats.motion_csv import read_motion_csv, write_motion_csv
from clra.io.motion_formats.motion_export import export_motion
from clra.io.motion_formats.rtk import read_rtk_geometry
from clra.model.geometry import ConeBeamGeometry
from clra.model.rigid.rigid_motion import RigidMotion
from clra.model.trajectory import helix

VIEWS = 5
POINTS = np.random.default_rng(5).uniform(-1.5, 1.5, (6, 3))


def _geometry(down: bool = False) -> ConeBeamGeometry:
    geometry = helix(
        VIEWS,
        angle_step=0.9,
        z_step=0.1,
        shape=(24, 40),
        pixel_size=0.5,
        source_to_axis=40.0,
        source_to_detector=100.0,
    )
    return upside_down(geometry) if down else geometry


def _motion(geometry: ConeBeamGeometry) -> RigidMotion:
    size = [0.3, 0.3, 0.3, 0.05, 0.05, 0.05]
    return RigidMotion.of(geometry, size * np.random.default_rng(2).normal(size=(VIEWS, 6)))


def _seen(geometry: ConeBeamGeometry, motion: RigidMotion) -> np.ndarray:
    """Where points are seen once they are turned and moved by hand, view by view."""
    pixels = []
    for view in range(VIEWS):
        u, v = (a[view] / np.linalg.norm(a[view]) for a in (geometry.u, geometry.v))
        axes = np.stack([u, v, geometry.normal[view]])
        handed = np.linalg.det(axes)  # a left-handed view turns the other way about its axes
        centre = geometry.source[view] + geometry.source_to_axis[view] * geometry.normal[view]
        turn = Rotation.from_rotvec(handed * motion.rotation[view] @ axes)
        moved = turn.apply(POINTS - centre) + motion.translation[view] @ axes + centre
        pixels.append(geometry.project(moved)[view])
    return np.array(pixels)


@pytest.mark.parametrize("down", [False, True])
def test_astras_vectors_see_the_moved_points(tmp_path: Path, down: bool) -> None:
    geometry = _geometry(down)
    motion = _motion(geometry)
    export_motion(tmp_path / "v.npy", "astra", motion, geometry=geometry)
    told = np.load(tmp_path / "v.npy")
    found = np.empty((VIEWS, len(POINTS), 2))
    for view, (source, detector, u, v) in enumerate(told.reshape(VIEWS, 4, 3)):
        for k, point in enumerate(POINTS):
            # source + a (point - source) = detector + i u + j v
            matrix = np.stack([point - source, -u, -v], axis=1)
            found[view, k] = np.linalg.solve(matrix, detector - source)[1:]
    middle = np.array([39 / 2, 23 / 2])
    assert found + middle == pytest.approx(_seen(geometry, motion), abs=1e-9)


def test_cils_arguments_see_the_moved_points(tmp_path: Path) -> None:
    geometry = _geometry()
    motion = _motion(geometry)
    export_motion(tmp_path / "g.npz", "cil", motion, geometry=geometry)
    assert geometry_of_cil(tmp_path / "g.npz").project(POINTS) == pytest.approx(
        _seen(geometry, motion), abs=1e-9
    )


def test_rtks_angles_and_offsets_see_the_moved_points(tmp_path: Path) -> None:
    geometry = _geometry()
    motion = _motion(geometry)
    export_motion(tmp_path / "g.xml", "rtk", motion, geometry=geometry)
    same = read_rtk_geometry(tmp_path / "g.xml", shape=(24, 40), pixel_size=0.5)
    assert same.project(POINTS) == pytest.approx(_seen(geometry, motion), abs=1e-9)


def test_a_table_keeps_rotations(tmp_path: Path) -> None:
    geometry = _geometry()
    motion, valid = _motion(geometry), np.arange(VIEWS) != 2
    write_motion_csv(tmp_path / "m.csv", motion, valid)
    found, good = read_motion_csv(tmp_path / "m.csv", geometry)
    assert isinstance(found, RigidMotion)
    assert found.table == pytest.approx(motion.table, abs=1e-15)
    assert np.array_equal(good, valid)
    with pytest.raises(InputError, match="view: found a rigid motion of 5, none, expected as many"):
        read_motion_csv(tmp_path / "m.csv")
    with pytest.raises(InputError, match="found a rigid motion of 5, 4 views of the scan"):
        read_motion_csv(tmp_path / "m.csv", geometry.subset(np.arange(4)))


@pytest.mark.parametrize(
    ("program", "message"),
    [
        ("nabu", "motion: found rotations of the sample, expected shifts for nabu's translations"),
        ("imod", "motion: found rotations of the sample, expected shifts for IMOD's transforms"),
        ("tigre", "a detector in view 0 that is tilted"),
    ],
)
def test_programs_that_know_no_rotations_refuse_them(
    tmp_path: Path, program: str, message: str
) -> None:
    geometry = _geometry()
    with pytest.raises(InputError, match=message):
        export_motion(tmp_path / "m", program, _motion(geometry), geometry=geometry)
    assert not list(tmp_path.iterdir())


def test_translations_alone_are_shifts(tmp_path: Path) -> None:
    geometry = _geometry()
    table = _motion(geometry).table * [1, 1, 1, 0, 0, 0]
    motion = RigidMotion.of(geometry, table)
    for name, moved in (("rigid", motion), ("plain", motion.caused_by("detector"))):
        export_motion(tmp_path / name, "imod", moved)
    assert (tmp_path / "rigid").read_text() == (tmp_path / "plain").read_text()
