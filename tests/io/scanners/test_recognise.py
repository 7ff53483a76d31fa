"""Every vendor's layout, written small, against closed forms of the numbers that it tells."""

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import vendor_files as vendor
from vendor_files import DEGREES, FAR, NEAR, PIXEL, SHAPE, VIEWS

from clra.errors import InputError
from clra.io.scan_files import import_scanner, read_scan
from clra.io.scanners.recognise import FORMATS, read_scanner, recognise
from clra.io.scanners.scanner_options import ScannerOptions
from clra.methods.execution.travelling import read_task, write_task
from clra.model.geometry import ConeBeamGeometry


@dataclass(frozen=True)
class Layout:
    """How a vendor writes, and the numbers of the scan that it writes, top up, seen from behind."""

    write: Callable[[Path, np.ndarray | None], Path]
    degrees: np.ndarray
    axis: float = 0.0
    principal: tuple[float, float] = (0.0, 0.0)
    options: dict[str, Any] = field(default_factory=dict)
    # Half a count of 50000, and float32.
    atol: float = 1.2e-5


def around() -> np.ndarray:
    """Vectors of a circle whose rows count down, (views, 12)."""
    b = np.deg2rad(-DEGREES)
    zero, up = np.zeros(VIEWS), np.full(VIEWS, 1.5)
    out = np.stack([np.sin(b), -np.cos(b), zero], axis=1)
    along = np.stack([np.cos(b), np.sin(b), zero], axis=1)
    down = np.stack([zero, zero, zero - PIXEL], axis=1)
    lifted = np.stack([zero, zero, up], axis=1)
    return np.hstack([NEAR * out + lifted, (NEAR - FAR) * out + lifted, PIXEL * along, down])


LAYOUTS = {
    # All mirrored: clockwise, columns to the left. Seen top up and from behind the axis is left.
    "nikon": Layout(vendor.write_nikon, -(40.0 + DEGREES), axis=-vendor.AXIS),
    "skyscan": Layout(vendor.write_skyscan, 15.0 * np.arange(VIEWS), principal=(0, vendor.ROW)),
    "phoenix": Layout(
        vendor.write_phoenix, np.round(DEGREES, 3), vendor.AXIS, (vendor.COLUMN, vendor.ROW)
    ),
    "tescan": Layout(
        vendor.write_tescan, 15.0 * np.arange(VIEWS), vendor.AXIS, (vendor.COLUMN, vendor.ROW)
    ),
    "zeiss": Layout(vendor.write_zeiss, np.float32(DEGREES).astype(float)),
    "dxchange": Layout(
        vendor.write_dxchange,
        DEGREES,
        options={"source_distance": NEAR, "detector_distance": FAR - NEAR, "pixel_size": PIXEL},
    ),
    "heliscan": Layout(
        vendor.write_heliscan,
        DEGREES,
        options={"angles": DEGREES, "shape": SHAPE, "z_translation": 0 * DEGREES},
    ),
    # The stage's u, the sample's x, points along the beam: a quarter of a turn behind.
    "ctsimu": Layout(vendor.write_ctsimu, 15.0 * np.arange(VIEWS) + 90.0),
    "geom": Layout(
        lambda folder, frames: vendor.write_geom(folder, frames, around()),
        DEGREES,
        principal=(0.0, 0.0),
        options={"shape": SHAPE},
    ),
}


def seen(layout: Layout, points: np.ndarray) -> np.ndarray:
    """Closed form of where points of the sample are seen, (views, n, 2): column, row."""
    turn = np.deg2rad(layout.degrees)[:, None]
    x, y, z = points.T
    right = np.cos(turn) * x - np.sin(turn) * y
    depth = NEAR + np.sin(turn) * x + np.cos(turn) * y
    right = right + (layout.axis - layout.principal[0]) * PIXEL * NEAR / FAR
    middle = (np.array(SHAPE[::-1]) - 1) / 2 + layout.principal
    column = middle[0] + right * FAR / depth / PIXEL
    return np.stack([column, middle[1] - z * FAR / depth / PIXEL], axis=-1)


def transmission(geometry: ConeBeamGeometry) -> np.ndarray:
    """Something different in every pixel of every view."""
    pixels = np.arange(geometry.views * geometry.rows * geometry.columns)
    return (0.2 + 0.7 * np.sin(pixels) ** 2).reshape(geometry.views, *geometry.shape)


@pytest.fixture(params=LAYOUTS)
def layout(request: pytest.FixtureRequest) -> Layout:
    if request.param == "zeiss":
        pytest.importorskip("olefile")
    return LAYOUTS[request.param]


@pytest.fixture
def points() -> np.ndarray:
    return np.random.default_rng(0).uniform(-1, 1, (11, 3))


def test_points_are_seen_where_the_numbers_say(
    layout: Layout, tmp_path: Path, points: np.ndarray
) -> None:
    path = layout.write(tmp_path, None)
    scan = read_scanner(path, ScannerOptions(**layout.options))
    height = 1.5 if path.suffix == ".geom" else 0.0
    found = scan.geometry.project(points + np.array([0, 0, height]))
    np.testing.assert_allclose(found, seen(layout, points), atol=2e-5)
    # Other programs' NXtomo fields are right for what is written: top down, to the right.
    assert np.all(scan.geometry.v[:, 2] < 0)


def test_radiographs_come_top_up_and_from_behind(layout: Layout, tmp_path: Path) -> None:
    path = layout.write(tmp_path, None)
    geometry = read_scanner(path, ScannerOptions(**layout.options)).geometry
    folder = tmp_path / "with"
    folder.mkdir()
    truth = transmission(geometry)
    path = layout.write(folder, truth)
    scan = read_scan(path, options=ScannerOptions(**layout.options))
    assert scan.geometry == geometry
    np.testing.assert_allclose(scan.projections[3:7], truth[3:7], atol=layout.atol)
    np.testing.assert_allclose(scan.read(0, VIEWS), -np.log(truth), atol=6 * layout.atol)
    by_folder = read_scan(folder, options=ScannerOptions(**layout.options))
    np.testing.assert_array_equal(by_folder.read(5, 6), scan.read(5, 6))


def test_a_scan_is_opened_by_another_process(layout: Layout, tmp_path: Path) -> None:
    pytest.importorskip("cloudpickle")
    options = ScannerOptions(**layout.options)
    geometry = read_scanner(layout.write(tmp_path, None), options).geometry
    folder = tmp_path / "with"
    folder.mkdir()
    scan = read_scan(layout.write(folder, transmission(geometry)), options=options)
    expected = scan.read(1, 5)  # files are open by now
    write_task(tmp_path / "task", scan)
    np.testing.assert_array_equal(read_task(tmp_path / "task").read(1, 5), expected)


def test_import_writes_the_same_scan(layout: Layout, tmp_path: Path) -> None:
    options = ScannerOptions(**layout.options)
    geometry = read_scanner(layout.write(tmp_path, None), options).geometry
    folder = tmp_path / "with"
    folder.mkdir()
    path = layout.write(folder, transmission(geometry))
    import_scanner(tmp_path / "scan.nxs", read_scanner(path, options))
    direct, written = read_scan(path, options=options), read_scan(tmp_path / "scan.nxs")
    np.testing.assert_allclose(
        written.geometry.to_astra(), direct.geometry.to_astra(), rtol=0, atol=1e-12
    )
    np.testing.assert_array_equal(written.read(0, VIEWS), direct.read(0, VIEWS))
    if layout.principal == (0, 0):
        # NXtomo's own fields, which other programs read, say the same.
        fields = read_scan(tmp_path / "scan.nxs", source_distance=NEAR)
        inside = np.random.default_rng(1).uniform(-1, 1, (9, 3))
        np.testing.assert_allclose(
            fields.geometry.project(inside), direct.geometry.project(inside), atol=1e-4
        )


def test_options_turn_what_they_say(layout: Layout, tmp_path: Path, points: np.ndarray) -> None:
    path = layout.write(tmp_path, None)

    def pixels(points: np.ndarray, **options: Any) -> np.ndarray:
        scan = read_scanner(path, ScannerOptions(**layout.options, **options))
        return scan.geometry.project(points)

    plain = pixels(points)
    width = SHAPE[1] - 1
    if layout.axis == 0 and layout.principal == (0, 0) and path.suffix not in (".geom", ".json"):
        mirrored = points * [-1, 1, 1]
        # The other sense and mirrored columns together make the mirror image of the sample.
        both = pixels(mirrored, flip="columns", rotation="ccw")
        assert np.abs(both - plain)[1:].max() > 0.5
        other = "cw"
        both = pixels(mirrored, flip="columns", rotation=other)
        np.testing.assert_allclose(both[..., 0], width - plain[..., 0], atol=1e-9)
        np.testing.assert_allclose(both[..., 1], plain[..., 1], atol=1e-9)
    placed = pixels(np.array([[0.0, 0.0, 0.0]]), centre_offset=(-2.5, 3.0))
    np.testing.assert_allclose(placed[:, 0, 0], width / 2 - 2.5, atol=1e-6)


def test_formats_are_told_apart_and_listed(tmp_path: Path) -> None:
    for number, layout in enumerate(LAYOUTS.values()):
        folder = tmp_path / str(number)
        folder.mkdir()
        path = layout.write(folder, None)
        by_file, by_folder = recognise(path), recognise(folder)
        assert by_file is not None and by_folder is not None
        assert by_file[0] is by_folder[0]
    foreign = tmp_path / "scan.vgi"
    foreign.write_text("{volume1}")
    with pytest.raises(InputError) as refused:
        read_scan(foreign)
    message = str(refused.value)
    assert "\n" not in message
    assert message.startswith(f"{foreign}: format: found suffix '.vgi', expected one of NXtomo")
    assert all(each.name in message for each in FORMATS)


def test_two_scans_in_a_folder(tmp_path: Path) -> None:
    path = vendor.write_nikon(tmp_path, None)
    (tmp_path / "Other.xtekct").write_bytes(path.read_bytes())
    with pytest.raises(InputError, match=r"scans: found 2: Lego\.xtekct, Other\.xtekct, expected"):
        recognise(tmp_path)


def test_frames_are_read_when_they_are_asked_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    geometry = read_scanner(vendor.write_skyscan(tmp_path, None)).geometry
    vendor.write_skyscan(tmp_path, transmission(geometry))
    scan = read_scan(tmp_path)
    for k in range(VIEWS):
        if k != 9:
            (tmp_path / f"bone_{k:04d}.tif").unlink()
    np.testing.assert_allclose(scan.projections[9:10], transmission(geometry)[9:10], atol=1.2e-5)


def test_a_last_radiograph_at_the_first_ones_place_is_left_out(tmp_path: Path) -> None:
    with h5py.File(vendor.write_dxchange(tmp_path, None), "r+") as file:
        file["exchange/theta"][...] = np.linspace(0, 360, VIEWS)
    scan = read_scanner(tmp_path, ScannerOptions(**LAYOUTS["dxchange"].options))
    assert scan.frames.shape == (VIEWS - 1, *SHAPE)
    assert "return" in [finding.code for finding in scan.findings]


def test_signs_without_real_radiographs_are_told(layout: Layout, tmp_path: Path) -> None:
    scan = read_scanner(layout.write(tmp_path, None), ScannerOptions(**layout.options))
    told = [str(finding) for finding in scan.findings]
    if scan.format == "CTSimU":  # made by a program whose conventions are written down
        assert not told
        return
    signs = [line for line in told if "not verified on a real scan" in line]
    assert signs and all("--" in line or "tells" in line for line in signs)
