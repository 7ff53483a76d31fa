import shutil
from pathlib import Path

import h5py
import numpy as np
import pytest
from geometries import upside_down

from clra.io.nxtomo.geometry_fields import far_source_distance, fields_of
from clra.io.nxtomo.writer import write_nxtomo
from clra.io.scan_files import read_scan, write_scan
from clra.model.geometry import ConeBeamGeometry
from clra.model.motion import Motion
from clra.model.scan import Scan
from clra.model.trajectory import circular, double_helix, helix, space_filling

from ..conftest import COLUMNS, ROLES, ROWS, VIEWS, Builder, put, transmission

# Rounding of degrees and of the distances' differences, relative to the scanner's size.
ROUNDING = 1e-12
DETECTOR = {"source_to_axis": 30.0, "source_to_detector": 300.0, "pixel_size": 0.5, "shape": (5, 6)}


def in_the_lab(
    points: np.ndarray, angle: float, translation: np.ndarray, *, sod: float, sdd: float
) -> np.ndarray:
    """Pixels (column, row) of points, from the words of the convention alone.

    The sample turns counter-clockwise seen from above, then moves; the source stands upstream on
    -y, columns run along +x, which is to the right as the source sees it, and rows run down.
    """
    c, s = np.cos(angle), np.sin(angle)
    x = c * points[:, 0] - s * points[:, 1] + translation[0]
    y = s * points[:, 0] + c * points[:, 1] + translation[1]
    z = points[:, 2] + translation[2]
    magnified = sdd / (sod + y)
    column = (COLUMNS - 1) / 2 + x * magnified / 0.05
    row = (ROWS - 1) / 2 - z * magnified / 0.06
    return np.stack([column, row], axis=1)


def test_fields_mean_what_the_convention_says(nxtomo_file: Builder) -> None:
    rng = np.random.default_rng(1)
    moved = rng.normal(size=(len(ROLES), 3))

    def translate(entry: h5py.Group) -> None:
        put(entry, "sample/x_translation", moved[:, 0], "mm")
        put(entry, "sample/y_translation", 1e3 * moved[:, 1], "um")
        put(entry, "sample/z_translation", 1e-3 * moved[:, 2], "m")

    geometry = read_scan(nxtomo_file(translate)).geometry
    points = rng.normal(size=(4, 3))
    frames = np.flatnonzero(ROLES == 0)
    expected = [
        in_the_lab(points, np.deg2rad(10.0 * f), moved[f], sod=200.0, sdd=500.0) for f in frames
    ]
    np.testing.assert_allclose(geometry.project(points), expected, rtol=0, atol=1e-9)
    assert geometry.axial


def test_clockwise_is_the_angle_reversed(nxtomo_file: Builder) -> None:
    def reverse(entry: h5py.Group) -> None:
        put(entry, "sample/rotation_angle", -np.deg2rad(10.0 * np.arange(len(ROLES))), "rad")

    clockwise = read_scan(nxtomo_file(), rotation="cw").geometry
    reversed_angles = read_scan(nxtomo_file(reverse, name="other.nxs")).geometry
    assert clockwise == reversed_angles
    assert clockwise != read_scan(nxtomo_file()).geometry


def test_counts_become_line_integrals(nxtomo_file: Builder) -> None:
    scan = read_scan(nxtomo_file())
    assert scan.kind == "transmission"
    assert scan.name == "scan.nxs"
    expected = -np.log(transmission())
    np.testing.assert_allclose(scan.read(0, VIEWS), expected, rtol=0, atol=1e-6)


@pytest.mark.parametrize("units", ["m", "metre", "mm", "um", "µm", "micron", "nm", b"mm"])
def test_units_are_read(nxtomo_file: Builder, units: str | bytes) -> None:
    name = units.decode() if isinstance(units, bytes) else units
    millimetres = {"m": 1e3, "metre": 1e3, "mm": 1, "nm": 1e-6}.get(name, 1e-3)

    def edit(entry: h5py.Group) -> None:
        put(entry, "instrument/source/distance", np.array([200.0 / millimetres]))
        entry["instrument/source/distance"].attrs["units"] = units

    geometry = read_scan(nxtomo_file(edit)).geometry
    np.testing.assert_allclose(geometry.source_to_axis, 200.0, rtol=1e-12)


def test_without_units_metres_and_degrees(nxtomo_file: Builder) -> None:
    def edit(entry: h5py.Group) -> None:
        put(entry, "instrument/source/distance", 0.2)
        put(entry, "sample/rotation_angle", 10.0 * np.arange(len(ROLES)))

    bare = read_scan(nxtomo_file(edit, name="bare.nxs")).geometry
    full = read_scan(nxtomo_file()).geometry
    np.testing.assert_allclose(bare.to_astra(), full.to_astra(), rtol=0, atol=200 * ROUNDING)


def test_a_pixel_of_the_wrong_unit_is_noticed(nxtomo_file: Builder) -> None:
    def edit(entry: h5py.Group) -> None:
        put(entry, "instrument/detector/x_pixel_size", 0.2)  # of mm, and taken as metres

    with pytest.warns(UserWarning, match=r"x_pixel_size: 200 mm: are the units right"):
        read_scan(nxtomo_file(edit))


def test_invalid_and_control_frames_are_left_out(nxtomo_file: Builder) -> None:
    roles = ROLES.copy()
    roles[5] = 3

    def edit(entry: h5py.Group) -> None:
        put(entry, "instrument/detector/image_key", roles)
        control = roles.copy()
        control[6] = -1
        put(entry, "instrument/detector/image_key_control", control.astype(float))

    scan = read_scan(nxtomo_file(edit))
    assert scan.views == VIEWS - 2
    assert any("2 frames marked invalid" in note for note in scan.projections.notes)
    expected = -np.log(np.delete(transmission(), [1, 2], axis=0))
    np.testing.assert_allclose(scan.read(0, VIEWS - 2), expected, rtol=0, atol=1e-6)


def test_white_stands_in_for_flats(nxtomo_file: Builder) -> None:
    def edit(entry: h5py.Group) -> None:
        put(entry, "instrument/detector/image_key", np.where(ROLES == 1, 3, ROLES))

    frames = np.full((len(ROLES), ROWS, COLUMNS), 100.0)
    frames[ROLES == 0] = 100 + 400 * transmission()
    scan = read_scan(nxtomo_file(edit, frames=frames), white=500.0)
    np.testing.assert_allclose(scan.projections[0:VIEWS], transmission(), rtol=1e-6)


def test_normalised_frames_without_keys_need_white_of_one(nxtomo_file: Builder) -> None:
    def edit(entry: h5py.Group) -> None:
        del entry["instrument/detector/image_key"]
        put(entry, "sample/rotation_angle", np.arange(VIEWS), "deg")

    scan = read_scan(nxtomo_file(edit, frames=transmission()), white=1.0)
    np.testing.assert_allclose(scan.projections[0:VIEWS], transmission(), rtol=1e-6)


def test_parallel_beam_is_a_far_source(nxtomo_file: Builder) -> None:
    def edit(entry: h5py.Group) -> None:
        del entry["instrument/source/distance"]

    geometry = read_scan(nxtomo_file(edit), parallel=True).geometry
    points = np.array([[0.15, 0.1, 0.1], [-0.1, 0.15, -0.1]])
    angles = np.deg2rad(10.0 * np.flatnonzero(ROLES == 0))
    across = np.cos(angles)[:, None] * points[:, 0] - np.sin(angles)[:, None] * points[:, 1]
    found = geometry.project(points)
    assert np.abs(found[..., 0] - ((COLUMNS - 1) / 2 + across / 0.05)).max() < 0.01
    assert np.abs(found[..., 1] - ((ROWS - 1) / 2 - points[:, 2] / 0.06)).max() < 0.01
    np.testing.assert_allclose(geometry.source_to_detector, geometry.source_to_axis)

    def endless(entry: h5py.Group) -> None:
        put(entry, "instrument/source/distance", -np.inf, "m")

    assert read_scan(nxtomo_file(endless, name="inf.nxs")).geometry == geometry


def test_overrides_beat_file_and_vectors(nxtomo_file: Builder, tmp_path: Path) -> None:
    assert read_scan(nxtomo_file(), source_distance=50.0).geometry.source_to_axis[0] == 50.0
    path = tmp_path / "ours.nxs"
    write_scan(path, Scan(np.zeros((4, 5, 6), np.float32), circular(4, **DETECTOR)))
    found = read_scan(path, source_distance=-50.0).geometry
    np.testing.assert_allclose(found.source_to_axis, 50.0, rtol=1e-12)


TRAJECTORIES = {
    "circular": circular(9, **DETECTOR),
    "arc": circular(5, start=1.0, arc=-2.0, **DETECTOR),
    "helix": helix(9, angle_step=0.5, z_step=0.1, **DETECTOR),
    "double-helix": double_helix(5, angle_step=0.7, z_step=0.1, **DETECTOR),
    "space-filling": space_filling(9, z_step=0.1, angle_step=2.7, **DETECTOR),
}


@pytest.mark.parametrize("name", TRAJECTORIES)
def test_trajectories_survive_with_and_without_our_group(name: str, tmp_path: Path) -> None:
    geometry = TRAJECTORIES[name]
    rng = np.random.default_rng(2)
    pixels = rng.random((geometry.views, 5, 6), np.float32)
    truth = Motion(
        shift_u=rng.normal(size=len(geometry)),
        shift_v=rng.normal(size=len(geometry)),
        cause="source",
    )
    mask = rng.random((5, 6)) > 0.3
    path = tmp_path / "scan.nxs"
    write_scan(path, Scan(pixels, geometry, truth=truth, mask=mask))
    scan = read_scan(path)
    # The rows of our trajectories count upwards, those of NXtomo downwards.
    assert scan.geometry == upside_down(geometry)
    assert scan.kind == "line-integrals"
    # Masked pixels were filled from beside when the scan was written.
    used = mask[::-1]
    np.testing.assert_array_equal(scan.read(0, len(geometry))[:, used], pixels[:, ::-1][:, used])
    np.testing.assert_array_equal(scan.mask, mask[::-1])
    np.testing.assert_array_equal(scan.truth.shift_u, truth.shift_u)
    np.testing.assert_array_equal(scan.truth.shift_v, -truth.shift_v)
    assert scan.truth.cause == "source"
    stripped = shutil.copy(path, tmp_path / "plain.nxs")
    with h5py.File(stripped, "r+") as file:
        assert file["entry/clra/cone_vectors"].attrs["fields_are_exact"]
        del file["entry/clra"]
    plain = read_scan(stripped)
    assert plain.truth is None
    np.testing.assert_allclose(
        plain.geometry.to_astra(), scan.geometry.to_astra(), rtol=0, atol=300 * ROUNDING
    )


def test_general_geometry_survives(tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    vectors = upside_down(TRAJECTORIES["helix"]).to_astra()
    vectors += 0.01 * rng.normal(size=vectors.shape)
    geometry = ConeBeamGeometry.from_astra(vectors, (5, 6))
    path = tmp_path / "scan.nxs"
    pixels = rng.random((len(geometry), 5, 6), np.float32)
    write_scan(path, Scan(pixels, geometry))
    scan = read_scan(path)
    assert scan.geometry == geometry
    np.testing.assert_array_equal(scan.read(0, len(geometry)), pixels)
    with h5py.File(path) as file:
        assert not file["entry/clra/cone_vectors"].attrs["fields_are_exact"]


def test_far_source_survives(tmp_path: Path) -> None:
    far = far_source_distance((5, 6), 0.5)
    geometry = upside_down(
        circular(7, **{**DETECTOR, "source_to_axis": far, "source_to_detector": far})
    )
    assert fields_of(geometry)[1]
    path = tmp_path / "scan.nxs"
    write_scan(path, Scan(np.zeros((7, 5, 6), np.float32), geometry))
    with h5py.File(path, "r+") as file:
        del file["entry/clra"]
    plain = read_scan(path).geometry
    np.testing.assert_allclose(plain.to_astra(), geometry.to_astra(), rtol=0, atol=far * ROUNDING)


@pytest.mark.parametrize("by", ["writing", "hand"])
@pytest.mark.parametrize("vectors", [True, False])
def test_invalid_frames_keep_geometry_and_truth_in_step(
    tmp_path: Path, by: str, vectors: bool
) -> None:
    geometry = upside_down(TRAJECTORIES["helix"])
    path = tmp_path / "scan.nxs"
    flats = np.full((2, 5, 6), 1000, np.uint16)
    pixels = np.tile(np.arange(100, 1000, 100, np.uint16)[:, None, None], (1, 5, 6))
    truth = Motion(shift_u=np.arange(9.0), shift_v=np.zeros(9))
    options = {"flats": flats, "darks": flats[:1] * 0, "truth": truth}
    kept = np.delete(np.arange(9), [0, 4])
    if by == "writing":
        options["valid_views"] = np.isin(np.arange(9), kept)
    write_nxtomo(path, pixels, geometry, **options)
    with h5py.File(path, "r+") as file:
        for key in ("image_key", "image_key_control"):
            keys = file[f"entry/instrument/detector/{key}"]
            if by == "hand":
                keys[[3, 3 + 4]] = 3
            assert keys[()].tolist() == [2, 1, 1, 3, 0, 0, 0, 3, 0, 0, 0, 0]
        if not vectors:
            del file["entry/clra/cone_vectors"]
    scan = read_scan(path)
    expected = geometry.subset(kept).to_astra()
    np.testing.assert_allclose(scan.geometry.to_astra(), expected, rtol=0, atol=300 * ROUNDING)
    np.testing.assert_array_equal(scan.truth.shift_u, kept)
    np.testing.assert_allclose(scan.projections[0:7][:, 0, 0], 0.1 * (1 + kept), rtol=1e-6)
    assert "2 frames marked invalid left out" in scan.projections.notes


@pytest.mark.parametrize(
    "valid_views", [np.ones(8, np.bool_), np.zeros(9, np.bool_), np.ones(9, int)]
)
def test_choices_of_views_that_are_none(tmp_path: Path, valid_views: np.ndarray) -> None:
    scan = Scan(np.zeros((9, 5, 6), np.float32), TRAJECTORIES["circular"])
    with pytest.raises(
        ValueError, match=r"valid_views: found .*, expected \(9,\) of bool with one or more"
    ):
        write_scan(tmp_path / "scan.nxs", scan, valid_views=valid_views)
    assert not list(tmp_path.iterdir())


def test_chunks_do_not_matter(nxtomo_file: Builder, tmp_path: Path) -> None:
    scan = read_scan(nxtomo_file())
    whole = scan.projections[0:VIEWS]
    parts = [scan.projections[i : i + 2] for i in range(0, VIEWS, 2)]
    np.testing.assert_array_equal(np.concatenate(parts), whole)
    np.testing.assert_array_equal(scan.projections[3], whole[3])
    np.testing.assert_array_equal(scan.projections[[5, 0, 1]], whole[[5, 0, 1]])
    np.testing.assert_array_equal(scan.subset([5, 0, 1]).projections[0:3], whole[[5, 0, 1]])


def test_progress_and_pieces(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("clra.io.nxtomo.writer._PIECE", 2 * 5 * 6 * 4)
    told = []
    pixels = np.random.default_rng(4).random((9, 5, 6), np.float32)
    path = tmp_path / "scan.nxs"
    write_scan(path, Scan(pixels, TRAJECTORIES["circular"]), progress=told.append)
    assert [p.done for p in told] == [2, 4, 6, 8, 9]
    assert {p.total for p in told} == {9}
    np.testing.assert_array_equal(read_scan(path).read(0, 9), pixels[:, ::-1])


def test_interrupted_writing_leaves_nothing(tmp_path: Path) -> None:
    class Interrupted:
        shape = (9, 5, 6)

        def __getitem__(self, views: slice) -> np.ndarray:
            if views.start > 0 or views.stop > 1:
                raise KeyboardInterrupt
            return np.zeros((1, 5, 6), np.float32)

    with pytest.raises(KeyboardInterrupt):
        write_nxtomo(tmp_path / "scan.nxs", Interrupted(), TRAJECTORIES["circular"])
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("rotation", ["ccw", "cw"])
def test_python_reads_the_same_frames_with_the_same_words(
    nxtomo_file: Builder, rotation: str
) -> None:
    def square(entry: h5py.Group) -> None:
        put(entry, "instrument/detector/y_pixel_size", 0.05, "mm")

    read = read_scan(nxtomo_file(square), rotation=rotation).geometry
    made = circular(
        VIEWS,
        source_to_axis=200.0,
        source_to_detector=500.0,
        pixel_size=0.05,
        shape=(ROWS, COLUMNS),
        start=np.radians(10.0 * np.flatnonzero(ROLES == 0)[0]),
        arc=np.radians(10.0 * VIEWS),
        rotation=rotation,
        row0="top",
    )
    np.testing.assert_allclose(made.to_astra(), read.to_astra(), rtol=0, atol=1e-9)


def test_a_written_scan_keeps_the_words(tmp_path: Path) -> None:
    geometry = helix(7, angle_step=0.3, z_step=0.1, rotation="ccw", row0="top", **DETECTOR)
    frames = np.random.default_rng(0).random((7, 5, 6)).astype(np.float32)
    write_scan(tmp_path / "scan.nx", Scan(frames, geometry))
    read = read_scan(tmp_path / "scan.nx")
    np.testing.assert_allclose(read.geometry.to_astra(), geometry.to_astra(), rtol=0, atol=1e-9)
    np.testing.assert_array_equal(read.read(0, 7), frames)
