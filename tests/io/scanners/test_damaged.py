"""Keys that are missing or broken: one line with file, field, what was found and expected."""

import re
from pathlib import Path

import h5py
import numpy as np
import pytest
import tifffile
import vendor_files as vendor

from clra.errors import InputError
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
TABLES = {"angles": np.arange(24.0), "shape": vendor.SHAPE}


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


def test_no_radiographs_beside_the_metadata(tmp_path: Path) -> None:
    path = vendor.write_nikon(tmp_path, None)
    scan = read_scan(path)
    expected = r"radiographs: found none, expected Lego_0001\.tif and so on"
    with pytest.raises(InputError, match=expected):
        scan.read(0, 1)
    with pytest.raises(InputError, match=expected):
        import_scanner(tmp_path / "scan.nxs", read_scanner(path))
    assert not (tmp_path / "scan.nxs").exists()


def test_frames_that_do_not_fit(tmp_path: Path) -> None:
    frames = np.full((vendor.VIEWS, *vendor.SHAPE), 0.5)
    path = vendor.write_skyscan(tmp_path, frames)
    (tmp_path / "bone_0007.tif").unlink()
    with pytest.raises(InputError, match="found 23 frames of 22 x 30, expected 24 of 22 x 30"):
        read_scan(path)
    tifffile.imwrite(tmp_path / "bone_0007.tif", np.zeros((3, 4), np.uint16))
    with pytest.raises(InputError, match=r"bone_0007\.tif: frame: found \(3, 4\)"):
        read_scan(path)


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
    with pytest.raises(InputError, match=r"pixel size: found none, expected --pixel-size MM"):
        read_scan(path)
    with pytest.raises(InputError, match=r"distances: found none.*--parallel, or in clra import"):
        read_scan(path, options=ScannerOptions(pixel_size=0.1))
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
    with pytest.raises(InputError, match="angles: found none, expected --angles FILE"):
        read_scan(path)
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
