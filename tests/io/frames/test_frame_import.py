"""Raw frames into an NXtomo file and out again."""

import re
import warnings
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import tifffile

from clra.errors import InputError
from clra.io.frames.frame_import import import_frames
from clra.io.frames.stacks import warn_of_gaps
from clra.io.scan_files import read_scan

VIEWS, ROWS, COLUMNS = 11, 5, 7
SCANNER = {"source_distance": 30.0, "detector_distance": 270.0, "pixel_size": 0.5}
RAW = {"shape": (ROWS, COLUMNS), "dtype": "uint16"}


@pytest.fixture
def counts() -> np.ndarray:
    rng = np.random.default_rng(0)
    return rng.integers(100, 900, (VIEWS, ROWS, COLUMNS)).astype(np.uint16)


@pytest.fixture
def fields(tmp_path: Path) -> dict[str, Any]:
    """Flat of 1000 and dark of 10 counts as TIFF, written beside the frames."""
    tifffile.imwrite(tmp_path / "flat.tif", np.full((ROWS, COLUMNS), 1000, np.uint16))
    tifffile.imwrite(tmp_path / "dark.tif", np.full((ROWS, COLUMNS), 10, np.uint16))
    return {"flats": tmp_path / "flat.tif", "darks": [tmp_path / "dark.tif"]}


def expected(counts: np.ndarray) -> np.ndarray:
    return -np.log((counts - 10.0) / 990.0)


def check(out: Path, counts: np.ndarray) -> None:
    np.testing.assert_allclose(
        read_scan(out).read(0, len(counts)), expected(counts), rtol=0, atol=1e-5
    )


@pytest.mark.parametrize("kind", ["pages", "contiguous", "compressed", "singles", "pattern"])
def test_tiff(kind: str, tmp_path: Path, counts: np.ndarray, fields: dict[str, Any]) -> None:
    frames: Any = tmp_path / "stack.tif"
    if kind == "pages":
        with tifffile.TiffWriter(frames) as writer:
            for image in counts:
                writer.write(image, contiguous=False, description="one page")
    elif kind == "contiguous":
        tifffile.imwrite(frames, counts, imagej=True, metadata={"axes": "TYX"})
    elif kind == "compressed":
        tifffile.imwrite(frames, counts, compression="zlib", rowsperstrip=2)
    else:
        frames = [tmp_path / f"scan_{i}.tif" for i in range(VIEWS)]
        for path, image in zip(frames, counts, strict=True):
            tifffile.imwrite(path, image)
        if kind == "pattern":  # 10 sorts after 9
            frames = str(tmp_path / "scan_*.tif")
    out = tmp_path / "scan.nxs"
    import_frames(out, frames, "0:300:11", **SCANNER, **fields)
    check(out, counts)


@pytest.mark.parametrize("byteorder", ["little", "big"])
def test_raw(byteorder: str, tmp_path: Path, counts: np.ndarray, fields: dict[str, Any]) -> None:
    for name, part in {"a.raw": counts[:4], "b.raw": counts[4:]}.items():
        pixels = part.astype("<u2" if byteorder == "little" else ">u2")
        (tmp_path / name).write_bytes(b"x" * 33 + pixels.tobytes())
    out = tmp_path / "scan.nxs"
    files = [tmp_path / "a.raw", tmp_path / "b.raw"]
    told = []
    import_frames(
        out, files, "0:300:11", **SCANNER, **fields, **RAW, byteorder=byteorder, header=33,
        progress=told.append,
    )  # fmt: skip
    check(out, counts)
    assert (told[-1].done, told[-1].total) == (VIEWS + 2, VIEWS + 2)


def test_geometry(tmp_path: Path, counts: np.ndarray, fields: dict[str, Any]) -> None:
    tifffile.imwrite(tmp_path / "stack.tif", counts)
    angles = tmp_path / "angles.txt"
    lines = [f"{12.5 * i:.3f}" for i in range(VIEWS)]
    angles.write_text("# degrees\n" + "\r\n".join(lines) + "  # the last\n\n")
    heights = np.linspace(-1, 2, VIEWS)
    out = tmp_path / "scan.nxs"
    arguments = {**SCANNER, **fields, "pixel_size": (0.4, 0.5), "z_translation": heights}
    import_frames(out, tmp_path / "stack.tif", angles, centre_offset=1.25, **arguments)
    geometry = read_scan(out).geometry
    np.testing.assert_allclose(np.linalg.norm(geometry.u, axis=1), 0.5)
    np.testing.assert_allclose(np.linalg.norm(geometry.v, axis=1), 0.4)
    np.testing.assert_allclose(geometry.source[:, 2], -heights, atol=1e-12)
    # The axis is seen where centre_offset says, whatever the height and the angle.
    pixels = geometry.project([[0.0, 0.0, -1.0], [0.0, 0.0, 1.0]])
    np.testing.assert_allclose(pixels[..., 0], (COLUMNS - 1) / 2 + 1.25, atol=1e-9)
    b = np.arctan2(geometry.u[:, 1], geometry.u[:, 0])
    np.testing.assert_allclose(np.rad2deg(np.unwrap(b)), -12.5 * np.arange(VIEWS), atol=1e-9)
    import_frames(out, tmp_path / "stack.tif", angles, rotation="cw", **arguments)
    b = np.arctan2(*read_scan(out).geometry.u.T[[1, 0]])
    np.testing.assert_allclose(np.rad2deg(np.unwrap(b)), 12.5 * np.arange(VIEWS), atol=1e-9)


@pytest.mark.parametrize("beam", [{"parallel": True}, {"source_distance": np.inf}])
def test_parallel(
    beam: dict[str, Any], tmp_path: Path, counts: np.ndarray, fields: dict[str, Any]
) -> None:
    tifffile.imwrite(tmp_path / "stack.tif", counts)
    out = tmp_path / "scan.nxs"
    import_frames(
        out, tmp_path / "stack.tif", "0:180:11", pixel_size=0.5, detector_distance=100.0,
        centre_offset=-1.5, **beam, **fields,
    )  # fmt: skip
    geometry = read_scan(out).geometry
    radius = 0.5 * COLUMNS / 2
    rim = np.linspace(0, 2 * np.pi, 9)
    points = radius * np.stack([np.cos(rim), np.sin(rim), 0.7 * np.sin(3 * rim)], axis=1)
    turn = np.deg2rad(np.linspace(0, 180, 11))[:, None]
    across = np.cos(turn) * points[:, 0] - np.sin(turn) * points[:, 1]
    found = geometry.project(points)
    # Half a hundredth each for the sample's width and for the axis off the middle.
    assert np.abs(found[..., 0] - ((COLUMNS - 1) / 2 - 1.5 + across / 0.5)).max() < 0.01
    assert np.abs(found[..., 1] - ((ROWS - 1) / 2 - points[:, 2] / 0.5)).max() < 0.01


def test_flats_of_another_type_are_kept_exact(tmp_path: Path, counts: np.ndarray) -> None:
    tifffile.imwrite(tmp_path / "stack.tif", counts)
    tifffile.imwrite(tmp_path / "flat.tif", np.full((ROWS, COLUMNS), 1000.5, np.float32))
    out = tmp_path / "scan.nxs"
    import_frames(out, tmp_path / "stack.tif", "0:300:11", **SCANNER, flats=tmp_path / "flat.tif")
    np.testing.assert_allclose(read_scan(out).projections[:], counts / 1000.5, rtol=1e-6)


def test_flats_before_and_after(tmp_path: Path, counts: np.ndarray, fields: dict[str, Any]) -> None:
    """The open beam fades from 1000 counts to 600: each radiograph has its own."""
    tifffile.imwrite(tmp_path / "stack.tif", counts)
    after = np.full((3, ROWS, COLUMNS), 600, np.uint16)
    tifffile.imwrite(tmp_path / "after.tif", after, photometric="minisblack")
    out, heights = tmp_path / "scan.nxs", np.linspace(-1, 2, VIEWS)
    made = import_frames(
        out, tmp_path / "stack.tif", "0:300:11", **SCANNER, **fields,
        flats_after=tmp_path / "after.tif", z_translation=heights,
    )  # fmt: skip
    assert (made.views, made.flats, made.darks, made.shape) == (VIEWS, 4, 1, (ROWS, COLUMNS))
    assert made.angles_deg == (0.0, 300.0)
    # Frames: a dark, a flat, eleven radiographs, three flats whose middle is frame 14.
    part = np.arange(1, VIEWS + 1) / 13
    beam = (1000 + part * (600 - 1000) - 10)[:, None, None]
    scan = read_scan(out)
    np.testing.assert_allclose(scan.projections[:], (counts - 10.0) / beam, rtol=1e-6)
    np.testing.assert_allclose(scan.geometry.source[:, 2], -heights, atol=1e-12)
    with h5py.File(out) as file:  # the plain fields, which other programs read
        angles = file["entry/sample/rotation_angle"][()]
        np.testing.assert_allclose(angles, [0, 0, *np.arange(0, 301, 30), 300, 300, 300])


@pytest.mark.parametrize("kind", ["transmission", "line-integrals"])
def test_frames_that_are_no_counts(kind: str, tmp_path: Path, counts: np.ndarray) -> None:
    values = (counts / 1000).astype(np.float32)
    tifffile.imwrite(tmp_path / "stack.tif", values)
    import_frames(tmp_path / "scan.nxs", tmp_path / "stack.tif", "0:300:11", **SCANNER, kind=kind)
    expected = values if kind == "line-integrals" else -np.log(values)
    np.testing.assert_allclose(
        read_scan(tmp_path / "scan.nxs").read(0, VIEWS), expected, rtol=0, atol=1e-6
    )


@pytest.mark.parametrize(
    ("names", "told"),
    [
        ([f"scan2_{i:03}.tif" for i in (0, 5, 10, 20, 25)], "010.tif is followed by .*020.tif:"),
        ([f"{i}.tif" for i in (1, 10, 11, 2, 3, 4)], r" 10.tif, and 1 more such:|11.tif .* 2.tif"),
        ([f"a{i}b{i}.tif" for i in (1, 2, 4)], None),
        ([f"2_{i:03}.tif" for i in range(0, 25, 5)], None),
        ([f"{i}.tif" for i in "abd"], None),
    ],
)
def test_frames_that_are_missing_or_out_of_order_are_noticed(
    names: list[str], told: str | None, recwarn: pytest.WarningsRecorder
) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("always")
        warn_of_gaps([Path("folder7") / name for name in names])
    assert len(recwarn) == (told is not None)
    assert told is None or re.search(told, str(recwarn[0].message))


def test_angles_in_radians_are_noticed(
    tmp_path: Path, counts: np.ndarray, fields: dict[str, Any]
) -> None:
    tifffile.imwrite(tmp_path / "stack.tif", counts)
    with pytest.warns(UserWarning, match=r"angles go from 0 to 6\.2, and are taken as degrees"):
        import_frames(
            tmp_path / "scan.nxs", tmp_path / "stack.tif", "0:6.2:11", **SCANNER, **fields
        )


MISTAKES: dict[str, tuple[dict[str, Any], str]] = {
    "angles": ({"angles": "0:360:12"}, "angles: found 12 numbers, expected 11, one a frame"),
    "angle table": ({"angles": "angles.txt"}, "line 2: angles: found 'ten', expected one number"),
    "no table": ({"angles": "none.txt"}, "none.txt: angles: cannot be read: No such file"),
    "not finite": ({"angles": [np.nan] * VIEWS}, "angles: found nan at frame 0"),
    "source": ({"source_distance": 0.0}, r"--source-distance: .*found 0\.0.*--parallel"),
    "no source": ({"source_distance": None}, "--source-distance: .*found None"),
    "detector": ({"detector_distance": -1.0}, r"--detector-distance: .*found -1\.0"),
    "pixel": ({"pixel_size": 0.0}, r"--pixel-size: .*found 0\.0"),
    "rotation": ({"rotation": "left"}, "rotation: found 'left', expected ccw or cw"),
    "no file": ({"frames": "none.tif"}, "none.tif: no such file"),
    "no match": ({"frames": "none*.tif"}, r"none\*\.tif: no file matches"),
    "nothing": ({"frames": []}, "found no file, expected at least one"),
    "more angles": (
        {"angles": "0:1:9", "frames": ["stack.tif"] * 2},
        r"expected 22, one a frame from stack\.tif to stack\.tif",
    ),
    "folder": ({"frames": "."}, r"a folder: give its files, such as '\./\*\.tif'"),
    "kind": ({"kind": "grey"}, "--kind: kind: found 'grey', expected one of counts"),
    "flats of no counts": ({"kind": "transmission", "flats": "small.tif"}, "found .* and flats"),
    "whole transmission": ({"kind": "transmission"}, "stack.tif: pixels: found uint16, expected f"),
    "raw": ({"frames": "frames.raw"}, r"suffix '\.raw', expected a TIFF, or rows"),
    "raw size": ({"frames": "frames.raw", **RAW}, r"size: found 101 bytes .* a multiple of 70"),
    "raw type": ({"frames": "frames.raw", **RAW, "dtype": "grey"}, "dtype: found 'grey'"),
    "no tiff": ({"frames": "bad.tif"}, "bad.tif: cannot be read as TIFF"),
    "cut short": ({"frames": "short.tif"}, r"short.tif: size: found .* the file is cut short"),
    "colour": ({"frames": "colour.tif"}, "colour.tif: images: found .*, expected grey frames"),
    "other size": ({"frames": ["stack.tif", "small.tif"]}, r"small.tif: frame: found \(5, 6\)"),
    "other flat": ({"flats": "small.tif"}, r"small.tif: frame: found \(5, 6\) pixels"),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_mistakes(
    mistake: str, tmp_path: Path, counts: np.ndarray, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    tifffile.imwrite("stack.tif", counts)
    tifffile.imwrite("small.tif", counts[0, :, :-1])
    tifffile.imwrite("colour.tif", np.zeros((4, 5, 3), np.uint8), photometric="rgb")
    Path("bad.tif").write_text("not at all")
    Path("frames.raw").write_bytes(b"x" * 101)
    Path("short.tif").write_bytes(Path("stack.tif").read_bytes()[:600])
    Path("angles.txt").write_text("0\nten\n")
    changes, message = MISTAKES[mistake]
    arguments = {"frames": "stack.tif", "angles": "0:360:11", **SCANNER, **changes}
    with pytest.raises(InputError, match=message) as caught:
        import_frames(tmp_path / "scan.nxs", **arguments)
    assert "\n" not in str(caught.value)
    assert not list(tmp_path.glob("*scan.nxs*"))


def test_damaged_page_is_named(tmp_path: Path, counts: np.ndarray) -> None:
    path = tmp_path / "stack.tif"
    tifffile.imwrite(path, counts, compression="zlib")
    with tifffile.TiffFile(path) as tiff:
        offset, size = tiff.pages[6].dataoffsets[0], tiff.pages[6].databytecounts[0]
    with open(path, "r+b") as file:
        file.seek(offset)
        file.write(b"\xff" * size)
    with pytest.raises(InputError, match=r"stack\.tif: frame 6: cannot be read"):
        import_frames(tmp_path / "scan.nxs", path, "0:300:11", **SCANNER)
    assert not list(tmp_path.glob("*scan.nxs*"))


def corners_of_stl(path: Path) -> np.ndarray:
    """Vertices of a binary STL file, (n, 3)."""
    record = np.dtype([("normal", "<f4", 3), ("vertices", "<f4", (3, 3)), ("rest", "<u2")])
    return np.fromfile(path, record, offset=84)["vertices"].reshape(-1, 3).astype(float)


def test_foreign_simulation_lands_in_its_shadow(data: Path, tmp_path: Path) -> None:
    """The wire tetrahedron of a foreign simulator: mirrored axes or a reversed turn would show."""
    folder = data / "ctsimu_tetrahedron"
    out = tmp_path / "tetra.nxs"
    import_frames(
        out, folder / "tetra_projections.raw", "0:360:21", shape=(150, 150), pixel_size=1.3,
        source_distance=300.0, detector_distance=100.0,
        flats=str(folder / "tetra_flat_*.raw"), darks=folder / "tetra_dark.raw",
    )  # fmt: skip
    scan = read_scan(out)
    pixels = scan.read(0, 21)
    assert np.median(pixels) == pytest.approx(0.0, abs=0.01)
    np.testing.assert_array_equal(pixels[0], pixels[20])
    # The scene gives the middle of the object on the stage: x along the beam, y to the left, z up.
    corners = corners_of_stl(folder / "tetra.stl")
    corners += [9.428083, 0, 8.888888] - (corners.min(axis=0) + corners.max(axis=0)) / 2
    points = np.stack([-corners[:, 1], corners[:, 0], corners[:, 2]], axis=1)
    for image, seen in zip(pixels, scan.geometry.project(points), strict=True):
        rows, columns = np.nonzero(image > 0.05)
        for projection, predicted in ((columns, seen[:, 0]), (rows, seen[:, 1])):
            assert projection.min() == pytest.approx(predicted.min(), abs=2.0)
            assert projection.max() == pytest.approx(predicted.max(), abs=2.0)


def test_synchrotron_scan(data: Path, tmp_path: Path) -> None:
    folder = data / "dls_24737" / "image_test"
    out = tmp_path / "dls.nxs"
    frames = str(folder / "tiffs" / "*.tiff")
    fields = {"flats": folder / "flat_00001.tiff", "darks": folder / "dark_00001.tiff"}
    with pytest.raises(InputError, match="found 111 numbers, expected 91"):
        import_frames(out, frames, folder / "angles.txt", parallel=True, pixel_size=0.01, **fields)
    # The table has ten flats and darks at either end.
    angles = np.loadtxt(folder / "angles.txt")[10:101]
    import_frames(out, frames, angles, parallel=True, pixel_size=0.01, centre_offset=6.5, **fields)
    scan = read_scan(out)
    pixels = scan.read(0, 91)
    assert scan.shape == (91, 135, 160)
    assert 0.3 < np.median(pixels) < 0.45
    assert pixels.max() < 4
    # First and last view are half a turn apart: mirror images about the axis.
    first, last = (p.mean(axis=0) - p.mean() for p in pixels[[0, -1]])
    lag = np.correlate(first, last[::-1], "full").argmax() - 159
    axis = scan.geometry.project([[0.0, 0.0, 0.0]])[0, 0, 0]
    assert axis - 79.5 == pytest.approx(lag / 2, abs=1.0)


def test_a_detector_on_its_side(tmp_path: Path, counts: np.ndarray) -> None:
    """Frames turned by 90 degrees give the scan of upright ones, whose right end is the top."""
    tifffile.imwrite(tmp_path / "upright.tif", counts, photometric="minisblack")
    sideways = np.rot90(counts, -1, axes=(1, 2))
    np.testing.assert_array_equal(sideways[:, :, -1], counts[:, 0])  # right column: top row
    tifffile.imwrite(tmp_path / "sideways.tif", sideways, photometric="minisblack")
    scans = []
    for name, axis, pixel in (("upright", "vertical", (0.5, 0.4)),
                              ("sideways", "horizontal", (0.4, 0.5))):  # fmt: skip
        out = tmp_path / f"{name}.nxs"
        options: dict[str, Any] = {**SCANNER, "pixel_size": pixel, "axis": axis}
        import_frames(out, tmp_path / f"{name}.tif", "0:300:11", **options)
        scans.append(read_scan(out, white=1000.0))
    one, other = scans
    np.testing.assert_array_equal(one.read(0, VIEWS), other.read(0, VIEWS))
    np.testing.assert_allclose(one.geometry.to_astra(), other.geometry.to_astra(), atol=1e-12)
    with pytest.raises(InputError, match="--axis: axis: found 'tilted'"):
        import_frames(tmp_path / "x.nxs", tmp_path / "upright.tif", "0:300:11", axis="tilted",
                      **SCANNER)  # fmt: skip


def test_excluded_radiographs_are_marked(tmp_path: Path, counts: np.ndarray) -> None:
    tifffile.imwrite(tmp_path / "stack.tif", counts, photometric="minisblack")
    out = tmp_path / "scan.nxs"
    import_frames(out, tmp_path / "stack.tif", "0:300:11", exclude=(2, 9), **SCANNER)
    with h5py.File(out) as file:
        key = file["entry/instrument/detector/image_key"][()]
    assert np.flatnonzero(key == 3).tolist() == [2, 9]
    scan = read_scan(out, white=1000.0)
    assert scan.views == VIEWS - 2
    left = np.delete(counts, [2, 9], axis=0)
    np.testing.assert_allclose(scan.read(0, 9), -np.log(left / 1000), atol=1e-5)
    with pytest.raises(InputError, match="exclude: found view 11, expected some of 11 views"):
        import_frames(out, tmp_path / "stack.tif", "0:300:11", exclude=(11,), **SCANNER)
