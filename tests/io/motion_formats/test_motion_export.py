"""A point is seen where the motion says, by each program's own formula or by the program."""

from pathlib import Path

import numpy as np
import pytest
from geometries import geometry_of_cil, upside_down

from clra.errors import InputError
from clra.io.motion_formats.motion_csv import read_motion_csv, write_motion_csv
from clra.io.motion_formats.motion_export import export_motion
from clra.model.geometry import ConeBeamGeometry
from clra.model.motion import Motion
from clra.model.trajectory import circular, helix

DETECTOR = {
    "shape": (24, 40),
    "pixel_size": 0.5,
    "source_to_axis": 40.0,
    "source_to_detector": 100.0,
}
VIEWS = 7
POINTS = np.random.default_rng(5).uniform(-1.5, 1.5, (6, 3))


def _motion(magnified: float = 0.02) -> Motion:
    rng = np.random.default_rng(2)
    return Motion(
        shift_u=rng.uniform(-3, 3, VIEWS),
        shift_v=rng.uniform(-3, 3, VIEWS),
        magnification=1 + magnified * rng.uniform(-1, 1, VIEWS),
    )


def _seen(geometry: ConeBeamGeometry, motion: Motion) -> np.ndarray:
    """Where the definition of a motion puts the points: c + m (q - c) + shift."""
    middle = np.array([(geometry.columns - 1) / 2, (geometry.rows - 1) / 2])
    shift = np.stack([motion.shift_u, motion.shift_v], axis=1)[:, None]
    moved = motion.magnification[:, None, None] * (geometry.project(POINTS) - middle)
    return middle + moved + shift


def test_a_table_survives(tmp_path: Path) -> None:
    motion, valid = _motion(), np.arange(VIEWS) != 3
    write_motion_csv(tmp_path / "m.csv", motion, valid)
    assert (tmp_path / "m.csv").read_text().startswith("view,shift_u_pixel,shift_v_pixel,magnif")
    found, good = read_motion_csv(tmp_path / "m.csv")
    assert found == motion
    assert np.array_equal(good, valid)


def test_a_table_may_be_brief_and_in_any_order(tmp_path: Path) -> None:
    (tmp_path / "m.csv").write_text(
        "# by hand\nshift_v_pixel,view,shift_u_pixel\n2,1,-1\n0.5,0,3\n", encoding="utf-8"
    )
    motion, valid = read_motion_csv(tmp_path / "m.csv")
    assert (motion.shift_u.tolist(), motion.shift_v.tolist()) == ([3, -1], [0.5, 2])
    assert motion.magnification.tolist() == [1, 1] and valid.all()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "header: found no lines"),
        ("view,shift_u_pixel\n0,1\n", "found columns view, shift_u_pixel, expected shift_v_pixel"),
        ("shift_u_pixel,shift_v_pixel\n1,x\n", "shift_v_pixel: found what is no finite number"),
        ("view,shift_u_pixel,shift_v_pixel\n0,1,1\n0,1,1\n", "view: found views missing or twice"),
    ],
)
def test_what_is_no_table_is_refused(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "m.csv").write_text(text)
    with pytest.raises(InputError, match=message):
        read_motion_csv(tmp_path / "m.csv")


@pytest.mark.parametrize("down", [False, True])
def test_astra_sees_the_points_where_they_are(tmp_path: Path, down: bool) -> None:
    geometry, motion = circular(VIEWS, **DETECTOR), _motion()
    geometry = upside_down(geometry) if down else geometry
    export_motion(tmp_path / "v.npy", "astra", motion, geometry=geometry)
    source, detector, u, v = np.split(np.load(tmp_path / "v.npy"), 4, axis=1)
    found = np.empty((VIEWS, len(POINTS), 2))
    for view in range(VIEWS):
        # A ray through the detector's plane, which ASTRA spans by u and v from its centre.
        basis = np.stack([u[view], v[view]], axis=1)
        for k, point in enumerate(POINTS):
            ray = point - source[view]
            normal = np.cross(u[view], v[view])
            hit = source[view] + ray * ((detector[view] - source[view]) @ normal) / (ray @ normal)
            found[view, k] = np.linalg.lstsq(basis, hit - detector[view], rcond=None)[0]
    middle = np.array([39 / 2, 23 / 2])
    assert found + middle == pytest.approx(_seen(geometry, motion), abs=1e-9)


def test_astra_itself_projects_a_spot_there(tmp_path: Path) -> None:
    """In the plane of a fan: its projector on the CPU is two-dimensional."""
    astra = pytest.importorskip("astra")
    geometry = circular(VIEWS, **(DETECTOR | {"shape": (1, 1001), "pixel_size": 0.02}))
    motion = Motion(shift_u=10 * _motion().shift_u, shift_v=np.zeros(VIEWS))
    export_motion(tmp_path / "v.npy", "astra", motion, geometry=geometry)
    vectors = np.load(tmp_path / "v.npy")[:, [0, 1, 3, 4, 6, 7]]
    volume = astra.create_vol_geom(80, 80, -2, 2, -2, 2)
    image = np.zeros((80, 80), np.float32)
    image[21, 57] = 1  # row 0 is at the highest y
    spot = np.array([[-2 + 57.5 * 0.05, 2 - 21.5 * 0.05, 0.0]])
    projector = astra.create_projector(
        "line_fanflat", astra.create_proj_geom("fanflat_vec", 1001, vectors), volume
    )
    _, sinogram = astra.create_sino(image, projector)
    centre = (sinogram * np.arange(1001)).sum(axis=1) / sinogram.sum(axis=1)
    expected = geometry.project(spot)[:, 0, 0] + motion.shift_u
    # A voxel is 6 columns wide, and lines sample it.
    assert centre == pytest.approx(expected, abs=0.2)


@pytest.mark.slow
def test_rtk_itself_projects_the_points_there(tmp_path: Path) -> None:
    itk = pytest.importorskip("itk")
    geometry, motion = helix(VIEWS, angle_step=0.5, z_step=0.1, **DETECTOR), _motion()
    export_motion(tmp_path / "g.xml", "rtk", motion, geometry=geometry)
    reader = itk.RTK.ThreeDCircularProjectionGeometryXMLFileReader.New()
    reader.SetFilename(str(tmp_path / "g.xml"))
    reader.GenerateOutputInformation()
    found = []
    points = np.stack([POINTS[:, 0], POINTS[:, 2], -POINTS[:, 1], np.ones(len(POINTS))])
    for view in range(VIEWS):
        matrix = reader.GetOutputObject().GetMatrix(view)
        matrix = np.array([[matrix(i, j) for j in range(4)] for i in range(3)])
        x, y, depth = matrix @ points
        # Pixels of 0.5 mm about the middle of the stack.
        found.append(np.stack([x / depth / 0.5 + 39 / 2, y / depth / 0.5 + 23 / 2], axis=1))
    # The pixel is the median of those with the motion in them.
    scale = np.median(1 / motion.magnification)
    middle = np.array([39 / 2, 23 / 2])
    assert middle + (np.array(found) - middle) / scale == pytest.approx(
        _seen(geometry, motion), abs=1e-6
    )


@pytest.mark.parametrize("down", [False, True])
@pytest.mark.parametrize("trajectory", ["circle", "helix"])
def test_tigre_sees_the_points_where_they_are(tmp_path: Path, trajectory: str, down: bool) -> None:
    """By the formula of TIGRE's kernels, see :func:`tigre_arrays`."""
    geometry = (
        circular(VIEWS, **DETECTOR)
        if trajectory == "circle"
        else helix(VIEWS, angle_step=0.5, z_step=0.1, **DETECTOR)
    )
    geometry = upside_down(geometry) if down else geometry
    motion = _motion()
    export_motion(tmp_path / "g.npz", "tigre", motion, geometry=geometry)
    told = np.load(tmp_path / "g.npz")
    rows, columns = told["nDetector"]
    found = np.empty((VIEWS, len(POINTS), 2))
    for view, a in enumerate(told["angles"]):
        toward, across = np.array([np.cos(a), np.sin(a), 0]), np.array([-np.sin(a), np.cos(a), 0])
        source = told["DSO"][view] * toward
        off_v, off_u = told["offDetector"][view]
        for k, point in enumerate(POINTS + told["offOrigin"][view][::-1]):
            ray = point - source
            hit = source - ray * told["DSD"][view] / (ray @ toward)
            column = (hit @ across - off_u) / told["dDetector"][1] + (columns - 1) / 2
            row = (hit[2] - off_v) / told["dDetector"][0] + (rows - 1) / 2
            found[view, k] = (
                columns - 1 - column if told["flip_columns"] else column,
                rows - 1 - row if told["flip_rows"] else row,
            )
    assert bool(told["flip_rows"]) == down
    assert found == pytest.approx(_seen(geometry, motion), abs=1e-9)


def test_cil_sees_the_points_where_they_are(tmp_path: Path) -> None:
    geometry, motion = helix(VIEWS, angle_step=0.5, z_step=0.1, **DETECTOR), _motion()
    export_motion(tmp_path / "g.npz", "cil", motion, geometry=geometry)
    assert geometry_of_cil(tmp_path / "g.npz").project(POINTS) == pytest.approx(
        _seen(geometry, motion), abs=1e-9
    )


def _spots(motion: Motion, height: int, width: int) -> tuple[np.ndarray, tuple[float, float]]:
    """Radiographs of a spot that is at the same pixel but for the motion."""
    y, x = np.mgrid[:height, :width]
    at = (width / 2 + 3, height / 2 - 4)
    images = [
        np.exp(-((x - at[0] - u) ** 2 + (y - at[1] - v) ** 2) / 8)
        for u, v in zip(motion.shift_u, motion.shift_v, strict=True)
    ]
    return np.array(images, np.float32), at


def _centre(image: np.ndarray) -> tuple[float, float]:
    y, x = np.indices(image.shape)
    return (image * x).sum() / image.sum(), (image * y).sum() / image.sum()


@pytest.mark.parametrize("cone", [False, True])
def test_nabu_itself_moves_the_spot_back(tmp_path: Path, cone: bool) -> None:
    shift_module = pytest.importorskip("nabu.preproc.shift")
    motion = _motion(magnified=0.0)
    far = {} if cone else {"source_to_axis": 1e6, "source_to_detector": 1e6}
    export_motion(tmp_path / "m.txt", "nabu", motion, geometry=circular(VIEWS, **(DETECTOR | far)))
    told = np.loadtxt(tmp_path / "m.txt")
    images, at = _spots(motion, 40, 60)
    shift_module.VerticalShift(images.shape, told[:, 1]).apply_vertical_shifts(images)
    for image, u in zip(images, motion.shift_u, strict=True):
        assert _centre(image) == pytest.approx((at[0] + u, at[1]), abs=0.02)
    # Towards which side the axis is corrected, by nabu's own geometry for ASTRA.
    assert told[:, 0] == pytest.approx(-motion.shift_u if cone else motion.shift_u)
    if cone:
        module = pytest.importorskip("nabu.reconstruction.cone")
        angles = np.linspace(0, 2 * np.pi, VIEWS, endpoint=False)
        made = module.ConebeamReconstructor(
            (24, VIEWS, 40),
            40.0,
            60.0,
            angles=angles,
            pixel_size=0.5,
            extra_options={"axis_correction": told[:, 0] * 0.5},
        )
        vectors = made.proj_geom["Vectors"]
        across = np.stack([np.cos(angles), np.sin(angles)], axis=1)
        # The detector moves against the radiograph.
        moved = np.sum(vectors[:, 3:5] * across, axis=1)
        assert np.sign(moved) == pytest.approx(-np.sign(motion.shift_u))


def test_imods_transform_moves_the_spot_back(tmp_path: Path) -> None:
    motion = _motion()
    export_motion(tmp_path / "m.xf", "imod", motion)
    told = np.loadtxt(tmp_path / "m.xf")
    geometry = circular(VIEWS, **DETECTOR)
    middle = np.array([39 / 2, 23 / 2])
    x, y = np.moveaxis((_seen(geometry, motion) - middle) * [1, -1], 2, 0)
    a11, a12, a21, a22, dx, dy = told.T[:, :, None]
    back = np.stack([a11 * x + a12 * y + dx, -(a21 * x + a22 * y + dy)], axis=2) + middle
    assert back == pytest.approx(geometry.project(POINTS), abs=1e-6)


def test_what_cannot_be_exported_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="to: found 'excel', expected one of astra, cil, csv"):
        export_motion(tmp_path / "m", "excel", _motion())
    with pytest.raises(InputError, match="geometry: found none, expected the scan's to export to"):
        export_motion(tmp_path / "m", "astra", _motion())
    geometry = circular(VIEWS, **DETECTOR)
    tilted = ConeBeamGeometry(
        source=geometry.source,
        detector=geometry.detector,
        u=geometry.u + 0.1 * geometry.v,
        v=geometry.v - 0.1 * geometry.u,
        shape=geometry.shape,
    )
    with pytest.raises(InputError, match="tilted"):
        export_motion(tmp_path / "m", "tigre", _motion(), geometry=tilted)
    assert not list(tmp_path.iterdir())
