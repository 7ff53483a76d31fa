"""Small scans in the layouts of scanners' vendors, written from what is known of these.

Each writer gets transmission (views, rows, columns) with row 0 the top and columns to the right as
seen from the source, or None for metadata alone, and stores it as its vendor does.
"""

import json
from pathlib import Path

import h5py
import numpy as np
import tifffile
from ole_writer import write_ole

VIEWS, SHAPE = 24, (22, 30)
NEAR, FAR, PIXEL = 30.0, 120.0, 0.4
WHITE, DARK = 50000, 100
# Turn of the sample in each view, by no even steps.
DEGREES = 15.0 * np.arange(VIEWS) + 2.0 * np.sin(np.arange(VIEWS))
# Where the axis and the perpendicular from the source fall, from the middle of the stored
# radiograph, in pixels; where a format tells them.
AXIS, COLUMN, ROW = 1.25, 0.5, -1.75


def _tiffs(folder: Path, pattern: str, frames: np.ndarray, first: int = 0) -> None:
    for number, frame in enumerate(frames, first):
        tifffile.imwrite(folder / pattern.format(number), frame)


def _counted(transmission: np.ndarray, white: float = WHITE, dark: float = 0.0) -> np.ndarray:
    return np.rint(dark + transmission * (white - dark)).astype(np.uint16)


def write_nikon(folder: Path, transmission: np.ndarray | None) -> Path:
    rows, columns = SHAPE
    path = folder / "Lego.xtekct"
    lines = [
        "[XTekCT]", "Name=Lego", "InputSeparator=_", f"SrcToObject={NEAR}", "InputName=Lego",
        f"SrcToDetector={FAR}", f"DetectorPixelsX={columns}", f"DetectorPixelSizeX={PIXEL}",
        "DetectorOffsetX=0.0", f"DetectorPixelsY={rows}", f"DetectorPixelSizeY={PIXEL}",
        f"Projections={VIEWS}", "InitialAngle=40.0", "AngularStep=15.0", f"WhiteLevel={WHITE}",
        f"ObjectOffsetX={AXIS * PIXEL * NEAR / FAR}", "ObjectTilt=0.0", "ObjectRoll=0.0",
    ]  # fmt: skip
    path.write_text("\r\n".join(lines))
    table = "\r\n".join(f"{k + 1}\t{angle:08.4f}\t{k:08.4f}" for k, angle in enumerate(DEGREES))
    header = f"Projections\tFrames\tExposure(ms)\r\n{VIEWS}\t1\t708.00\r\nProjection\tAngle(deg)\t"
    extra = f"\r\n{VIEWS + 1}\t361.0\t99.0\r\n"
    (folder / "_ctdata.txt").write_text(f"{header}Time(s)\r\n{table}{extra}")
    if transmission is not None:
        _tiffs(folder, "Lego_{:04d}.tif", _counted(transmission)[:, :, ::-1], 1)
    return path


def write_skyscan(folder: Path, transmission: np.ndarray | None) -> Path:
    rows, columns = SHAPE
    path = folder / "bone_.log"
    lines = [
        "[System]", "Scanner=SkyScan1173", "Camera Pixel Size (um)=50.0", "[Acquisition]",
        "Filename Prefix=bone_", f"Number Of Files= {VIEWS}", f"Number Of Rows= {rows}",
        f"Number of Columns= {columns}", f"Image Pixel Size (um)={1e3 * PIXEL * NEAR / FAR}",
        f"Object to Source (mm)={NEAR}", f"Camera to Source (mm)={FAR}",
        f"Optical Axis (line)= {(rows - 1) / 2 + ROW}", "Rotation Step (deg)=15.000",
        "Depth (bits)=16", f"Reference Intensity={WHITE}", "Flat Field Correction=ON",
        "Rotation Direction=CC", "[Reconstruction]", "Postalignment=0.00",
    ]  # fmt: skip
    path.write_text("\r\n".join(lines), encoding="latin-1")
    if transmission is not None:
        _tiffs(folder, "bone_{:04d}.tif", _counted(transmission))
    return path


def write_phoenix(folder: Path, transmission: np.ndarray | None) -> Path:
    rows, columns = SHAPE
    path = folder / "fly.pca"
    lines = [
        "[General]", "SystemName=v|tome|x µ", "[Geometry]", f"FDD={FAR}", f"FOD={NEAR}",
        f"CalibValue={AXIS - COLUMN}", f"cx={(columns - 1) / 2 + COLUMN}",
        f"cy={(rows - 1) / 2 + ROW}", "DetectorRot=0.0", "[CT]", f"NumberImages={VIEWS}",
        "RotationSector=360.0", "[CalibValue]", "NumberImages=18", "[Image]", f"DimX={columns}",
        f"DimY={rows}", f"FreeRay={WHITE}", "[Detector]", f"PixelsizeX={PIXEL}",
        f"PixelsizeY={PIXEL}", f"NrPixelsX={columns + 10}", f"NrPixelsY={rows}",
    ]  # fmt: skip
    path.write_text("\n".join(lines), encoding="latin-1")
    free = WHITE * (1 - 0.001 * np.arange(VIEWS))  # the tube fades
    table = [
        f"{k + 1}\t{angle:.3f}\t90\t109\t{free[k]:.1f}\t-0.9\t0.0\t1\t0.000\t-5\t2023-05-30 09:58"
        for k, angle in enumerate(DEGREES)
    ]
    header = "datos|x 2 acquisition 2.4.0\nImgNr\tRotPos\tU\tI\tMeanGV\tDevGV\tDose"
    (folder / "fly.pcp").write_text("\n".join([header, *table]))
    if transmission is not None:
        counts = np.stack(
            [_counted(t, w) for t, w in zip(transmission, np.round(free, 1), strict=True)]
        )
        _tiffs(folder, "fly{:04d}.tif", counts, 1)
    return path


def write_tescan(folder: Path, transmission: np.ndarray | None) -> Path:
    rows, columns = SHAPE
    path = folder / "scan settings.txt"
    lines = [
        f"COR : {columns / 2 + AXIS}", f"VC : {rows / 2 + ROW}", f"HC : {columns / 2 + COLUMN}",
        f"SDD : {FAR}", f"SOD : {NEAR}", f"Voxel size : {1e3 * PIXEL * NEAR / FAR}",
        f"Binned pixel size : {PIXEL}", "Binning value : 2",
        f"ROI (LTRB) : 0,12,{2 * columns - 1},{11 + 2 * rows}", "ver_tube : 36.9 ; speed : 37.5",
        f"# projections: {VIEWS}", "Start angle : 0.000000", "Last angle : 360.000000",
        "# post flat fields: 1",
    ]  # fmt: skip
    path.write_text("\r\n".join(lines))
    if transmission is not None:
        _tiffs(folder, "scan_{:06d}.tif", _counted(transmission, dark=DARK))
        flats = np.full((3, *SHAPE), WHITE, np.uint16)
        _tiffs(folder, "io{:06d}.tif", flats)
        _tiffs(folder, "di{:06d}.tif", np.full((2, *SHAPE), DARK, np.uint16))
    return path


def write_dxchange(folder: Path, transmission: np.ndarray | None) -> Path:
    path = folder / "tooth.h5"
    with h5py.File(path, "w") as file:
        counts = _counted(np.ones((VIEWS, *SHAPE)) if transmission is None else transmission)
        file["exchange/data"] = counts
        file["exchange/data_white"] = np.full((2, *SHAPE), WHITE, np.uint16)
        file["exchange/data_dark"] = np.zeros((2, *SHAPE), np.uint16)
        file["exchange/theta"] = DEGREES
        file["exchange/theta"].attrs["units"] = "degrees"
    return path


def write_zeiss(
    folder: Path,
    transmission: np.ndarray | None,
    shifts: tuple[np.ndarray, np.ndarray] | None = None,
) -> Path:
    """Rows are stored from the bottom up; shifts are what moves each stored radiograph back."""
    rows, columns = SHAPE
    path = folder / "chip.txrm"
    counts = _counted(np.ones((VIEWS, *SHAPE)) if transmission is None else transmission)
    whole = {
        "NoOfImages": VIEWS, "ImagesTaken": VIEWS, "ImageWidth": columns, "ImageHeight": rows,
        "DataType": 5, "XrayGeometry": 1,
    }  # fmt: skip
    real = {
        "Angles": DEGREES, "StoRADistance": np.full(VIEWS, -NEAR),
        "DtoRADistance": np.full(VIEWS, FAR - NEAR), "YPosition": np.full(VIEWS, 7.0),
        "pixelsize": [1e3 * PIXEL * NEAR / FAR],
    }  # fmt: skip
    streams = {f"ImageInfo/{name}": np.int32(value).tobytes() for name, value in whole.items()}
    streams |= {f"ImageInfo/{name}": np.float32(value).tobytes() for name, value in real.items()}
    for k, image in enumerate(counts[:, ::-1], 1):
        streams[f"ImageData1/Image{k}"] = image.tobytes()
    streams["ReferenceData/Image"] = np.full(SHAPE, WHITE, np.float32).tobytes()
    if shifts is not None:
        for name, values in zip(("X-Shifts", "Y-Shifts"), shifts, strict=True):
            streams[f"Alignment/{name}"] = np.float32(values).tobytes()
    write_ole(path, streams)
    return path


def write_heliscan(folder: Path, transmission: np.ndarray | None) -> Path:
    raw = folder / "proju16_raw"
    raw.mkdir()
    path = raw / "expt_rock.in"
    path.write_text(
        "BeginSection acquisition\n"
        f"camera_length {FAR}\nspecimen_distance {NEAR}\npixel_size_x {PIXEL}\n"
        f"voxel_size {PIXEL * NEAR / FAR}\niterative_trajectory 1\nEndSection\n"
    )
    if transmission is not None:
        parts = {
            "KF": _counted(transmission, dark=DARK),
            "CF": np.full((2, *SHAPE), WHITE),
            "DF": np.full((1, *SHAPE), DARK),
        }
        for role, frames in parts.items():
            (raw / f"rawfiles_{role}0000").mkdir()
            for k, frame in enumerate(frames):
                place = raw / f"rawfiles_{role}0000" / f"expt_{role}{k:06d}.raw"
                frame.astype("<u2").tofile(place)
    return path


def write_ctsimu(
    folder: Path, transmission: np.ndarray | None, deviations: dict[str, list] | None = None
) -> Path:
    """A turn by the stage about the world's z, seen along +x; detector and stage may deviate."""
    rows, columns = SHAPE
    path = folder / "scene.json"

    def vector(x: float, y: float, z: float) -> dict:
        return {axis: {"value": v, "unit": "mm"} for axis, v in zip("xyz", (x, y, z), strict=True)}

    def part(name: str, x: float, u: tuple, w: tuple) -> dict:
        return {
            "center": vector(x, 0, 0), "vector_u": vector(*u), "vector_w": vector(*w),
            "deviations": (deviations or {}).get(name, []),
        }  # fmt: skip

    scenario = {
        "file": {
            "name": "scene", "file_type": "CTSimU Scenario",
            "file_format_version": {"major": 1, "minor": 2},
        },
        "geometry": {
            "source": part("source", 0, (0, -1, 0), (1, 0, 0)),
            "stage": part("stage", NEAR, (1, 0, 0), (0, 0, 1)),
            "detector": part("detector", FAR, (0, -1, 0), (1, 0, 0)),
        },
        "detector": {
            "columns": {"value": columns, "unit": "px"}, "rows": {"value": rows, "unit": "px"},
            "pixel_pitch": {a: {"value": 1e3 * PIXEL, "unit": "um"} for a in "uv"},
        },
        "source": {"voltage": {"value": 130, "unit": "kV"}},
        "samples": [],
        "materials": [],
        "acquisition": {
            "start_angle": {"value": 0, "unit": "deg"}, "stop_angle": {"value": 360, "unit": "deg"},
            "direction": "CCW", "number_of_projections": VIEWS, "include_final_angle": False,
        },
    }  # fmt: skip
    path.write_text(json.dumps(scenario))
    if transmission is not None:
        _counted(transmission, dark=DARK).astype("<u2").tofile(folder / "views.raw")
        np.full((2, *SHAPE), WHITE, "<u2").tofile(folder / "flat.raw")
        np.full((1, *SHAPE), DARK, "<u2").tofile(folder / "dark.raw")
        projections = {
            "filename": "views.raw", "number": VIEWS, "datatype": "uint16", "byteorder": "little",
            "headersize": {"file": 0, "image": 0}, "max_intensity": WHITE,
            "flat_field": {"filename": "flat.raw", "number": 2, "projections_corrected": False},
            "dark_field": {"filename": "dark.raw", "number": 1},
        }  # fmt: skip
        metadata = {
            "file": {"file_type": "CTSimU Metadata"},
            "output": {"projections": projections},
            "acquisition_geometry": {"path_to_CTSimU_JSON": "../scene.json"},
        }
        (folder / "scene_metadata.json").write_text(json.dumps(metadata))
    return path


def write_geom(folder: Path, transmission: np.ndarray | None, vectors: np.ndarray) -> Path:
    """As the CWI walnuts: the TIFFs lie on their side, the first vectors are of the last frame.

    Parameters
    ----------
    vectors : ndarray, (views, 12)
        Of the frames in their order, rows of the radiographs from the top down.
    """
    path = folder / "scan_geom_corrected.geom"
    upwards = vectors * np.repeat([1, 1, 1, -1], 3)
    np.savetxt(path, upwards[::-1], fmt="%.12g")
    if transmission is not None:
        frames = _counted(transmission, dark=DARK)[:, ::-1]  # rows from the bottom up
        _tiffs(folder, "scan_{:06d}.tif", frames.transpose(0, 2, 1)[:, ::-1])
        portrait = SHAPE[::-1]
        _tiffs(folder, "io{:06d}.tif", np.full((2, *portrait), WHITE, np.uint16))
        _tiffs(folder, "di{:06d}.tif", np.full((1, *portrait), DARK, np.uint16))
    return path
