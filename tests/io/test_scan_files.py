"""Damaged and foreign scan files: each gives one line that names file, field, found, expected."""

import os
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest

from clra.errors import InputError
from clra.io.scan_files import read_scan
from clra.model.scan import Scan
from clra.model.trajectory import circular

from .conftest import COLUMNS, ROLES, ROWS, Builder, counts, put

Edit = Callable[[h5py.Group], None]


def setting(name: str, value: object, units: str | None = None) -> Edit:
    return lambda entry: put(entry, name, value, units)


def without(name: str) -> Edit:
    def edit(entry: h5py.Group) -> None:
        del entry[name]

    return edit


def replacing(name: str, link: object) -> Edit:
    def edit(entry: h5py.Group) -> None:
        del entry[name]
        entry[name] = link

    return edit


DISTANCE = "instrument/source/distance"
DATA = "instrument/detector/data"
DAMAGES = {
    "no source distance": (without(DISTANCE), rf"entry/{DISTANCE}: found nothing.*--parallel"),
    "zero source distance": (setting(DISTANCE, 0.0, "mm"), rf"{DISTANCE}: found 0 mm.*--source"),
    "zero detector distance": (
        setting("instrument/detector/distance", 0.0, "mm"),
        "detector/distance: found 0 mm, expected above 0 mm",
    ),
    "no detector distance": (
        without("instrument/detector/distance"),
        "detector/distance: found nothing, expected the distance",
    ),
    "distance in words": (
        setting("instrument/detector/distance", np.array([b"far"])),
        "detector/distance: found .*far",
    ),
    "endless translation": (
        setting("sample/z_translation", np.full(len(ROLES), np.nan), "mm"),
        "z_translation: found nan at frame 4",
    ),
    "nameless angle": (
        setting("sample/rotation_angle", [0.0] * 9 + [np.inf] + [0.0] * 3, "degree"),
        "rotation_angle: found inf at frame 9",
    ),
    "unknown unit": (setting(DISTANCE, 5.0, "furlong"), "@units: found 'furlong', expected one of"),
    "no pixel size": (without("instrument/detector/x_pixel_size"), "x_pixel_size: found nothing"),
    "zero pixel size": (setting("instrument/detector/y_pixel_size", 0.0), "found 0 mm"),
    "too few angles": (
        setting("sample/rotation_angle", np.arange(5.0), "degree"),
        f"rotation_angle: found 5 angles, expected {len(ROLES)}, one a frame",
    ),
    "no angles": (without("sample/rotation_angle"), "rotation_angle: found nothing"),
    "too few keys": (setting("instrument/detector/image_key", ROLES[:-1]), "image_key: found 12"),
    "too many translations": (
        setting("sample/x_translation", np.zeros(3), "mm"),
        "x_translation: found 3 values, expected 1 or 13",
    ),
    "no flat": (
        setting("instrument/detector/image_key", np.where(ROLES == 1, 3, ROLES)),
        "image_key: found no flat.*--white",
    ),
    "no radiograph": (
        setting("instrument/detector/image_key", np.full(len(ROLES), 1)),
        "found no radiograph",
    ),
    "flats and darks swapped": (
        setting("instrument/detector/image_key", np.where(ROLES > 0, 3 - ROLES, 0)),
        "flats that are not above the darks in 30 of 30 pixels",
    ),
    "flat frames": (setting(DATA, np.zeros((13, 5))), r"data: found shape \(13, 5\)"),
    "frames of text": (setting(DATA, np.full((13, 5, 6), b"x")), "found shape .*S1"),
    "no frames": (without(DATA), "detector/data: found nothing"),
    "soft link": (
        replacing(DATA, h5py.SoftLink("/raw/frames")),
        rf"{DATA}: found a link to /raw/frames that leads nowhere",
    ),
    "external link": (
        replacing(DATA, h5py.ExternalLink("raw.h5", "/raw/frames")),
        rf"{DATA}: found a link to raw\.h5:/+raw/frames that leads nowhere",
    ),
    "link to itself": (replacing(DATA, h5py.SoftLink("/entry/" + DATA)), "leads nowhere"),
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_damaged_files(nxtomo_file: Builder, damage: str) -> None:
    edit, message = DAMAGES[damage]
    path = nxtomo_file(edit)
    with pytest.raises(InputError, match=message) as caught:
        read_scan(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert "\n" not in str(caught.value)


def test_virtual_frames_of_a_missing_file(nxtomo_file: Builder, tmp_path: Path) -> None:
    with h5py.File(tmp_path / "raw.h5", "w") as file:
        file["frames"] = counts()

    def edit(entry: h5py.Group) -> None:
        layout = h5py.VirtualLayout((len(ROLES), ROWS, COLUMNS), float)
        layout[:] = h5py.VirtualSource("raw.h5", "frames", shape=layout.shape)
        del entry[DATA]
        entry.create_virtual_dataset(DATA, layout)

    path = nxtomo_file(edit)
    whole = read_scan(path).read(0, 7)
    os.rename(tmp_path / "raw.h5", tmp_path / "lost.h5")
    # HDF5 itself would hand out zeros.
    with pytest.raises(InputError, match=r"data: found a part in raw\.h5:frames"):
        read_scan(path)
    os.rename(tmp_path / "lost.h5", tmp_path / "raw.h5")
    np.testing.assert_array_equal(read_scan(path).read(0, 7), whole)


def test_flats_and_darks_need_no_angle(nxtomo_file: Builder) -> None:
    angles = np.where(ROLES == 0, 10.0 * np.arange(len(ROLES)), np.nan)
    some = read_scan(nxtomo_file(setting("sample/rotation_angle", angles), name="some.nxs"))
    assert some.geometry == read_scan(nxtomo_file()).geometry


def test_compression_that_is_not_installed(
    nxtomo_file: Builder, monkeypatch: pytest.MonkeyPatch
) -> None:
    def edit(entry: h5py.Group) -> None:
        del entry[DATA]
        entry.create_dataset(DATA, data=counts(), chunks=(1, ROWS, COLUMNS), compression="lzf")

    path = nxtomo_file(edit)
    np.testing.assert_array_equal(read_scan(path).read(0, 7), read_scan(nxtomo_file()).read(0, 7))
    monkeypatch.setattr(h5py.h5z, "filter_avail", lambda code: False)
    monkeypatch.setattr("clra.io.hdf5.import_module", lambda name: None)
    path = nxtomo_file(edit, name="other.nxs")
    with pytest.raises(InputError, match=r"HDF5 filter 32000.* pip install hdf5plugin"):
        read_scan(path)


def test_no_hdf5(tmp_path: Path) -> None:
    path = tmp_path / "scan.nxs"
    with pytest.raises(InputError, match="no such file"):
        read_scan(path)
    path.write_text("not at all")
    with pytest.raises(InputError, match="signature: found b'not at a', expected an HDF5 file"):
        read_scan(path)
    with pytest.raises(InputError, match="none of a scanner's metadata, expected one of NXtomo"):
        read_scan(tmp_path)
    (tmp_path / "frame.tif").touch()
    with pytest.raises(InputError, match="clra import makes one"):
        read_scan(tmp_path / "frame.tif")
    (tmp_path / "scan.txrm").touch()
    with pytest.raises(InputError, match=r"cannot be read as \.txrm"):
        read_scan(tmp_path / "scan.txrm")


def test_truncated_hdf5(nxtomo_file: Builder) -> None:
    path = nxtomo_file()
    os.truncate(path, path.stat().st_size // 2)
    with pytest.raises(InputError, match="truncated"):
        read_scan(path)


def test_hdf5_that_is_no_scan(tmp_path: Path) -> None:
    path = tmp_path / "volume.h5"
    with h5py.File(path, "w") as file:
        file["volume"] = np.zeros((2, 2, 2))
    with pytest.raises(InputError, match="found groups volume, expected an NXtomo entry"):
        read_scan(path)


def test_several_entries(nxtomo_file: Builder) -> None:
    path = nxtomo_file()
    with h5py.File(path, "r+") as file:
        file.copy("entry", "second")
        put(file, "second/instrument/source/distance", 70.0, "mm")
    with pytest.raises(InputError, match="2 scans: entry, second, expected one"):
        read_scan(path)
    with pytest.raises(InputError, match="entry: found 'third', expected one of: entry, second"):
        read_scan(path, entry="third")
    assert read_scan(path, entry="second").geometry.source_to_axis[0] == pytest.approx(70.0)
    assert read_scan(path, entry="/entry").geometry.source_to_axis[0] == pytest.approx(200.0)


def test_old_layouts(nxtomo_file: Builder) -> None:
    """Subentries, `unit`, scalars as arrays, other detector names, angles beside the data."""

    def edit(entry: h5py.Group) -> None:
        file = entry.file
        file.create_group("scan")
        file.move("entry", "scan/tomo_entry")
        entry = file["scan/tomo_entry"]
        entry.move("instrument/detector", "instrument/camera")
        entry.move("sample/rotation_angle", "data/rotation_angle")
        entry["sample/x_translation"] = [0.0]
        entry["beam/energy"] = 20.0
        attributes = entry["instrument/source/distance"].attrs
        attributes["unit"] = np.bytes_(b"mm")
        del attributes["units"], entry["definition"]

    old = read_scan(nxtomo_file(edit, name="old.nxs"))
    assert old.geometry == read_scan(nxtomo_file()).geometry


def test_wrong_overrides(nxtomo_file: Builder) -> None:
    with pytest.raises(InputError, match="rotation: found 'left'"):
        read_scan(nxtomo_file(), rotation="left")
    with pytest.raises(InputError, match="source_distance: found 0"):
        read_scan(nxtomo_file(), source_distance=0.0)


def test_fields_in_several_senses_are_told(nxtomo_file: Builder) -> None:
    path = nxtomo_file(setting("instrument/detector/x_rotation_axis_pixel_position", 3.5))
    with pytest.warns(UserWarning, match="x_rotation_axis_pixel_position not used"):
        read_scan(path)


def test_vectors_that_do_not_fit(nxtomo_file: Builder) -> None:
    path = nxtomo_file(setting("clra/cone_vectors", np.zeros((3, 12))))
    with pytest.raises(InputError, match=r"cone_vectors: found shape \(3, 12\)"):
        read_scan(path)
    path = nxtomo_file(setting("clra/cone_vectors", np.full((13, 12), np.nan)))
    with pytest.raises(InputError, match="cone_vectors: found no numbers at frame 4"):
        read_scan(path)
    path = nxtomo_file(setting("clra/cone_vectors", np.zeros((13, 12))))
    with pytest.raises(InputError, match="cone_vectors: u and v: parallel or zero"):
        read_scan(path)


def test_unknown_kind(nxtomo_file: Builder) -> None:
    def edit(entry: h5py.Group) -> None:
        entry[DATA].attrs["clra_kind"] = "logarithms"

    with pytest.raises(InputError, match="clra_kind: found 'logarithms', expected one of"):
        read_scan(nxtomo_file(edit))


def test_checksum_tells_scans_apart() -> None:
    detector = {
        "source_to_axis": 3.0,
        "source_to_detector": 9.0,
        "pixel_size": 0.1,
        "shape": (3, 4),
    }
    geometry = circular(5, **detector)
    pixels = np.random.default_rng(0).random((5, 3, 4), np.float32)
    one = Scan(pixels, geometry).checksum()
    assert one == Scan(pixels.astype(np.float64), geometry, name="copy").checksum()
    assert one != Scan(pixels[:, ::-1], geometry).checksum()
    assert one.startswith("sha256:")


def test_real_files_with_links_that_lead_nowhere(data: Path) -> None:
    folder = data / "dls_24737"
    expected = r"24888\.nxs: .*detector/data: found a link to .*pco1-24888\.hdf:.*leads nowhere"
    with pytest.raises(InputError, match=expected):
        read_scan(folder / "24888.nxs")
    with pytest.raises(InputError, match=r"data: found a link to k11-18014/.*leads nowhere"):
        read_scan(folder / "k11-18014_dangling_links.nxs")
