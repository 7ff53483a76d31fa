"""Keys that are missing or broken: one line with file, field, what was found and expected."""

import re
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import h5py
import numpy as np
import pytest
import tifffile
import vendor_files as vendor

from clra.errors import ClraWarning, InputError
from clra.io.key_value_text import KeyValueText
from clra.io.scan_files import import_scanner, read_scan
from clra.io.scanners.recognise import read_scanner
from clra.io.scanners.scanner_options import ScannerOptions

TEXTS = {
    "nikon": (vendor.write_nikon, ("SrcToObject", "DetectorPixelsX", "Projections", "WhiteLevel")),
    "skyscan": (
        vendor.write_skyscan, ("Object to Source (mm)", "Number of Files", "Rotation Step (deg)")
    ),
    "phoenix": (vendor.write_phoenix, ("FDD", "PixelsizeX", "NrPixelsX", "SCO_NumPoints")),
    "tescan": (vendor.write_tescan, ("SDD", "# projections", "ROI (LTRB)")),
    "heliscan": (vendor.write_heliscan, ("camera_length", "pixel_size_x")),
}  # fmt: skip
CASES = [(name, key) for name, (_, keys) in TEXTS.items() for key in keys if key[:3] != "SCO"]
TABLES = {"angles": np.arange(24.0), "shape": vendor.SHAPE, "z_translation": np.zeros(24)}


def options(name: str) -> ScannerOptions:
    return ScannerOptions(**(TABLES if name == "heliscan" else {}))


def edited(path: Path, key: str, value: str | None) -> None:
    """Replace the value of a key; leave its line out without a value."""
    encoding = "latin-1"
    kept = []
    for line in path.read_text(encoding).splitlines():
        if re.match(rf"{re.escape(key)}\s*[=: ]", line, re.IGNORECASE):
            if value is not None:
                separator = next(mark for mark in "=: " if mark in line)
                kept.append(f"{line.partition(separator)[0]}{separator}{value}")
        else:
            kept.append(line)
    path.write_text("\n".join(kept), encoding)


@pytest.mark.parametrize(("name", "key"), CASES)
def test_missing_and_broken_keys(name: str, key: str, tmp_path: Path) -> None:
    path = TEXTS[name][0](tmp_path, None)
    whole = path.read_bytes()
    edited(path, key, None)
    with pytest.raises(InputError) as refused:
        read_scanner(path, options(name))
    told = str(refused.value)
    assert told.startswith(f"{path}: ") and "\n" not in told
    assert re.search(rf"{re.escape(key)}.*: found nothing, expected a", told)
    path.write_bytes(whole)
    edited(path, key, "far away")
    with pytest.raises(InputError, match=rf"{re.escape(key)}.*: found .*expected"):
        read_scanner(path, options(name))


@pytest.mark.parametrize("name", TEXTS)
def test_distances_of_nothing(name: str, tmp_path: Path) -> None:
    path = TEXTS[name][0](tmp_path, None)
    edited(path, TEXTS[name][1][0], "0")
    with pytest.raises(InputError, match=r"found '0', expected a number above 0"):
        read_scanner(path, options(name))


def test_a_detector_before_the_axis(tmp_path: Path) -> None:
    path = vendor.write_nikon(tmp_path, None)
    edited(path, "SrcToDetector", "20.0")
    with pytest.raises(InputError, match="distances: found 30 mm to the axis, 20 mm to the detec"):
        read_scanner(path)


def test_what_a_geometry_refuses_names_the_file(tmp_path: Path) -> None:
    path = vendor.write_geom(tmp_path, None, np.zeros((vendor.VIEWS, 12)))
    with pytest.raises(InputError) as refused:
        read_scanner(path, ScannerOptions(shape=vendor.SHAPE))
    assert str(refused.value).startswith(f"{path}: u and v: parallel or zero in view 0, expected")


def test_no_radiographs_beside_the_metadata(tmp_path: Path) -> None:
    path = vendor.write_nikon(tmp_path, None)
    scan = read_scan(path)
    expected = r"radiographs: found none, expected Lego_0001\.tif and so on"
    with pytest.raises(InputError, match=expected):
        scan.read(0, 1)
    with pytest.raises(InputError, match=expected):
        import_scanner(tmp_path / "scan.nxs", read_scanner(path))
    assert not (tmp_path / "scan.nxs").exists()


def test_threads_read_frames_of_many_files(tmp_path: Path) -> None:
    levels = np.linspace(0.1, 0.9, vendor.VIEWS)[:, None, None]
    path = vendor.write_skyscan(tmp_path, np.broadcast_to(levels, (vendor.VIEWS, *vendor.SHAPE)))
    projections = read_scan(path).projections
    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(lambda k: projections[k : k + 1][0, 3, 5], list(range(24)) * 8))
    np.testing.assert_allclose(found, np.tile(levels.ravel(), 8), atol=2e-5)


def test_frames_that_do_not_fit(tmp_path: Path) -> None:
    frames = np.full((vendor.VIEWS, *vendor.SHAPE), 0.5)
    path = vendor.write_skyscan(tmp_path, frames)
    tifffile.imwrite(tmp_path / "bone_0024.tif", np.zeros(vendor.SHAPE, np.uint16))
    with pytest.raises(InputError, match="found 25 frames of 22 x 30, expected 24 of 22 x 30"):
        read_scan(path)
    (tmp_path / "bone_0024.tif").unlink()
    tifffile.imwrite(tmp_path / "bone_0007.tif", np.zeros((3, 4), np.uint16))
    with pytest.raises(InputError, match=r"bone_0007\.tif: frame: found \(3, 4\)"):
        read_scan(path)


@pytest.mark.parametrize(
    ("write", "name"),
    [
        (vendor.write_nikon, "Lego_{:04d}.tif"), (vendor.write_skyscan, "bone_{:04d}.tif"),
        (vendor.write_phoenix, "fly{:04d}.tif"), (vendor.write_tescan, "scan_{:06d}.tif"),
    ],
)  # fmt: skip
def test_what_is_left_of_a_scan_keeps_its_angles(
    write: Callable[..., Path], name: str, tmp_path: Path
) -> None:
    levels = np.linspace(0.1, 0.9, vendor.VIEWS)[:, None, None]
    path = write(tmp_path, np.broadcast_to(levels, (vendor.VIEWS, *vendor.SHAPE)))
    whole = read_scan(path)
    first = int(not (tmp_path / name.format(0)).exists())
    lost = [3, 21, 22, 23]
    for view in lost:
        (tmp_path / name.format(view + first)).unlink()
    numbers = ", ".join(str(view + first) for view in lost)
    with pytest.warns(ClraWarning, match=rf"4 of 24 radiographs are missing: numbers {numbers}:"):
        rest = read_scan(path)
    left = np.setdiff1d(np.arange(vendor.VIEWS), lost)
    assert rest.geometry == whole.geometry.subset(left)
    found = rest.projections[0 : len(left)][:, 4, 5]
    np.testing.assert_allclose(found, levels.ravel()[left], atol=2e-5)


def test_tables_that_are_too_short(tmp_path: Path) -> None:
    path = vendor.write_nikon(tmp_path, None)
    table = tmp_path / "_ctdata.txt"
    lines = table.read_text().splitlines()
    table.write_text("\n".join(lines[:12]))
    with pytest.raises(InputError, match=r"_ctdata\.txt: angles: found 9 rows, expected 24"):
        read_scanner(path)
    table.write_text("\n".join([*lines[:12], "ten past ten"]))
    with pytest.raises(InputError, match="expected number, angle"):
        read_scanner(path)


def test_data_exchange_needs_distances_and_frames(tmp_path: Path) -> None:
    path = vendor.write_dxchange(tmp_path, None)
    with pytest.raises(InputError, match=r"distances: found none.*--parallel, or in clra import"):
        read_scan(path)
    near = ScannerOptions(source_distance=30, detector_distance=90)
    with pytest.raises(InputError, match=r"pixel size: found none, expected --pixel-size MM"):
        read_scan(path, options=near)
    with h5py.File(path, "r+") as file:
        del file["exchange/theta"]
        file["exchange/theta"] = np.arange(5.0)
    with pytest.raises(InputError, match=r"theta: found 5 angles, expected 24, one a frame"):
        read_scan(path, parallel=True)
    with h5py.File(path, "r+") as file:
        del file["exchange/theta"]
    with pytest.raises(InputError, match="angles: found none, expected --angles FILE"):
        read_scan(path, parallel=True)
    assert read_scan(path, parallel=True, options=ScannerOptions(angles="0:345:24")).views == 24


def test_heliscan_has_no_angles_of_its_own(tmp_path: Path) -> None:
    path = vendor.write_heliscan(tmp_path, np.full((vendor.VIEWS, *vendor.SHAPE), 0.5))
    still = {"z_translation": np.zeros(vendor.VIEWS)}
    scan = read_scanner(path, ScannerOptions(shape=vendor.SHAPE, **still))
    assert scan.geometry.views == vendor.VIEWS  # described it can be
    with (
        pytest.warns(ClraWarning, match="angles are not in this format: a turn is drawn"),
        pytest.raises(InputError, match="angles: found none in this format, expected --angles"),
    ):
        scan.scan().read(0, 1)
    with pytest.raises(InputError, match="angles: found none in this format, expected --angles"):
        import_scanner(tmp_path / "scan.nxs", scan)
    whole = path.read_text()
    path.write_text(f"{whole}detector_size_x 30\ndetector_size_y 22\nviews 660\nsections_y 1\n")
    with pytest.raises(InputError, match="found 660 pixels a frame, expected --shape"):
        read_scan(path)  # 22 x 30 or 1 x 660
    path.write_text(f"{whole}detector_size_x 30\ndetector_size_y 22\n")
    assert read_scanner(path).geometry.shape == vendor.SHAPE
    path.write_text(whole)
    with pytest.raises(
        InputError, match="rows and columns: found 660 pixels a frame, expected --sh"
    ):
        read_scan(path, options=ScannerOptions(angles="0:345:24"))


def test_txrm(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("olefile")
    path = vendor.write_zeiss(tmp_path, None)
    whole = path.read_bytes()
    path.write_bytes(whole[:700])
    with pytest.raises(InputError, match=r"chip\.txrm: .*"):
        read_scan(path)
    path.write_text("no container at all")
    with pytest.raises(InputError, match=r"cannot be read as \.txrm"):
        read_scan(path)
    path.write_bytes(whole.replace(np.float32(-vendor.NEAR).tobytes(), np.float32(0).tobytes()))
    with pytest.raises(InputError, match="StoRADistance: found 0, expected above 0 mm"):
        read_scan(path)
    monkeypatch.setitem(__import__("sys").modules, "olefile", None)
    with pytest.raises(
        InputError, match=r"need the package olefile: pip install 'clra\[scanners\]'"
    ):
        read_scan(path)


def test_broken_json(tmp_path: Path) -> None:
    path = vendor.write_ctsimu(tmp_path, None)
    text = path.read_text()
    path.write_text(text.replace('"vector_w"', '"vector_x"'))
    with pytest.raises(InputError, match=r"vector_w: found nothing, expected a value"):
        read_scan(path)
    path.write_text(text.replace('"unit": "um"', '"unit": "inch"'))
    with pytest.raises(InputError, match=r"pixel_pitch\.u: found unit 'inch', expected nm, um"):
        read_scan(path)
    path.write_text(text[:200])
    with pytest.raises(InputError, match=r"expected one of NXtomo"):
        read_scan(path)


@pytest.mark.parametrize(
    ("value", "number"),
    [
        ("12", 12.0),
        (" 1.5 mm", 1.5),
        ("0,25", 0.25),
        ("-1.5e-3", -1.5e-3),
        ("7.5 ; speed : 3", 7.5),
    ],
)
def test_numbers_as_scanners_write_them(value: str, number: float, tmp_path: Path) -> None:
    path = tmp_path / "scan.log"
    path.write_bytes(f"[A]\r\nThe  Key = {value}\r\n".encode("utf-16"))
    assert KeyValueText.read(path).number("the key") == number
    path.write_bytes(b"[A]\nkey=\xb5m\n")
    with pytest.raises(InputError, match=r"\[A\] key: found 'µm', expected a number"):
        KeyValueText.read(path).number("key", section="A")


WRITERS = {
    **{name: write for name, (write, _) in TEXTS.items()},
    "dxchange": vendor.write_dxchange,
    "zeiss": vendor.write_zeiss,
    "ctsimu": vendor.write_ctsimu,
}
PIECES = (b"-", b"1e9", b"0", b"\n", b"=", b"nan", b"[", b'"', b",", b"null", b"e")


def damaged(whole: bytes, random: np.random.Generator) -> bytes:
    """A few bytes changed, lost or put in; or the end lost."""
    for _ in range(random.integers(1, 4)):
        place, kind = int(random.integers(len(whole))), random.integers(4)
        if kind == 0:
            whole = whole[:place] + bytes([random.integers(256)]) + whole[place + 1 :]
        elif kind == 1:
            whole = whole[:place] + whole[place + int(random.integers(1, 30)) :]
        elif kind == 2:
            whole = whole[:place] + PIECES[random.integers(len(PIECES))] + whole[place:]
        else:
            whole = whole[:place]
        whole = whole or b"x"
    return whole


@pytest.mark.parametrize("name", WRITERS)
def test_damage_of_any_kind_is_the_files_fault(name: str, tmp_path: Path) -> None:
    if name == "zeiss":
        pytest.importorskip("olefile")
    path = WRITERS[name](tmp_path, None)
    kept = {file: file.read_bytes() for file in sorted(tmp_path.rglob("*")) if file.is_file()}
    random = np.random.default_rng(0)
    given = {"parallel": True} if name == "dxchange" else {}
    given |= TABLES if name == "heliscan" else {}
    for _ in range(60):
        file = list(kept)[random.integers(len(kept))]
        file.write_bytes(damaged(kept[file], random))
        try:
            scan = read_scanner(path, ScannerOptions(**given))
            if scan is not None and not scan.missing:
                np.asarray(scan.frames[0:2])
        except InputError as error:
            assert "\n" not in str(error)
        file.write_bytes(kept[file])
