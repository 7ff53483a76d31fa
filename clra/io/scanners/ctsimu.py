"""CTSimU: a scenario (JSON) and the metadata (JSON) of radiographs that were simulated by it.

Sources: the CTSimU file format 1.x (BAM), and a tetrahedron that the simulator aRTist made of such
a scenario. Units are in the file. The stage turns by +angle about its own w for CCW and by -angle
for CW; the detector's columns run along its u, its rows along v = w x u. The stage's u, v, w are
the sample's x, y, z. The geometry is what is known to the reconstruction; what is not, deviations
and drifts, is read as the motion that the simulation put in: per view the shift and magnification
that come nearest to how points about the axis move.

Metadata: ``output.projections`` with file name (of all frames, or with ``%04d``), type and byte
order; ``dark_field`` and ``flat_field`` likewise. max_intensity is the open beam of frames that are
corrected, or have no flats.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from clra.errors import InputError
from clra.findings import Finding
from clra.io.frames.frame_views import MissingFrames
from clra.io.frames.stacks import FrameStack, RawLayout
from clra.io.scanners.ctsimu_scene import Json, part_poses
from clra.io.scanners.scanner_options import ScannerOptions
from clra.io.scanners.scanner_scan import Frames, ScannerScan, assembled
from clra.model.geometry import ConeBeamGeometry
from clra.model.motion import Motion

# Half the edge of the cube of points by which a motion is measured, as part of the width that the
# detector sees at the axis; and motions below this are none [pixel].
_CUBE, _NONE = 0.25, 1e-9


def is_ctsimu(path: Path) -> bool:
    """Tell whether a JSON file says that it is CTSimU's; never raises for other files."""
    try:
        kind = Json.read(path).get("file", "file_type")
    except InputError:
        return False
    return kind is not None and str(kind.value).startswith("CTSimU")


def read_ctsimu(path: Path, options: ScannerOptions) -> ScannerScan:
    """Read a scenario, or metadata that lead to one, and the radiographs beside it.

    Parameters
    ----------
    path : Path
        Either file; of a scenario, metadata beside it that lead to it and have radiographs are
        looked for.
    options : ScannerOptions
        What the user says; angles, distances and pixels are those of the scenario.

    Raises
    ------
    InputError
        If something is missing or of a form that is not read, or frames do not fit.
    """
    told = Json.read(path)
    if "Metadata" in str(told.need("file", "file_type").value):
        metadata: Json | None = told
        scenario = Json.read(_scenario_of(told))
    else:
        scenario, metadata = told, _metadata_of(path)
    detector = scenario.need("detector")
    shape = (detector.need("rows").whole(), detector.need("columns").whole())
    views = scenario.need("acquisition", "number_of_projections").whole()
    real, known = (_geometry(scenario, views, shape, known_only=k) for k in (False, True))
    truth, findings = _hidden_motion(real, known)
    if metadata is None:
        message = f"{path}: radiographs: found none, expected CTSimU metadata beside it"
        parts: dict[str, Any] = {
            "frames": MissingFrames((views, *shape), message),
            "kind": "counts",
        }
    else:
        parts = _radiographs(metadata, (views, *shape))
    direction = str(_or(scenario.get("acquisition", "direction"), "CCW"))
    scan = ScannerScan(
        format="CTSimU",
        path=path,
        geometry=known,
        start_motion=truth,
        known_motion=truth,
        details=_details(scenario, direction),
        findings=findings,
        **parts,
    )
    return assembled(scan, options, rotation=direction.lower())


def _geometry(
    scenario: Json, views: int, shape: tuple[int, int], *, known_only: bool
) -> ConeBeamGeometry:
    """Source and detector as the turning stage sees them."""
    still = [0.0] * views
    stages = part_poses(
        scenario.need("geometry", "stage"), _turns(scenario, views), known_only=known_only
    )
    sources = part_poses(scenario.need("geometry", "source"), still, known_only=known_only)
    detectors = part_poses(scenario.need("geometry", "detector"), still, known_only=known_only)
    pitch = scenario.need("detector", "pixel_pitch")
    width, height = pitch.need("u").number("mm"), pitch.need("v").number("mm")
    rows = []
    for stage, source, detector in zip(stages, sources, detectors, strict=True):
        rows.append(
            [
                stage.axes @ (source.centre - stage.centre),
                stage.axes @ (detector.centre - stage.centre),
                stage.axes @ detector.axes[0] * width,
                stage.axes @ detector.axes[1] * height,
            ]
        )
    return ConeBeamGeometry.from_astra(np.array(rows).reshape(views, 12), shape)


def _turns(scenario: Json, views: int) -> list[float]:
    """Turn of the stage about its w in each frame [rad]."""
    acquisition = scenario.need("acquisition")
    start, stop = (acquisition.need(f"{k}_angle").number("deg") for k in ("start", "stop"))
    last = bool(_or(acquisition.get("include_final_angle"), False))
    step = (stop - start) / max(views - 1 if last else views, 1)
    sense = -1.0 if _or(acquisition.get("direction"), "CCW") == "CW" else 1.0
    return [sense * (start + k * step) for k in range(views)]


def _hidden_motion(
    real: ConeBeamGeometry, known: ConeBeamGeometry
) -> tuple[Motion | None, tuple[Finding, ...]]:
    """Motion of radiographs that the known geometry does not have."""
    width = known.columns * np.linalg.norm(known.u[0])
    half = _CUBE * float(width * known.source_to_axis[0] / known.source_to_detector[0])
    points = half * (np.indices((3, 3, 3)).reshape(3, -1).T - 1.0)
    middle = np.array([(known.columns - 1) / 2, (known.rows - 1) / 2])
    ideal, moved = (g.project(points) - middle for g in (known, real))
    if not np.isfinite([moved, ideal]).all():
        raise InputError("geometry: found a source among what the detector sees, expected it apart")
    if np.abs(moved - ideal).max() < _NONE:
        return None, ()
    fitted, rest = [], 0.0
    for q, p in zip(ideal, moved, strict=True):
        ones, nothing = np.ones(len(q)), np.zeros(len(q))
        across = np.stack([ones, nothing, q[:, 0]], axis=1)
        along = np.stack([nothing, ones, q[:, 1]], axis=1)
        system = np.concatenate([across, along])
        seen = np.concatenate([p[:, 0], p[:, 1]])
        solution = np.linalg.lstsq(system, seen, rcond=None)[0]
        fitted.append(solution)
        rest = max(rest, float(np.abs(system @ solution - seen).max()))
    u, v, magnification = np.array(fitted).T
    message = (
        f"deviations that are not known to the reconstruction are the true motion: up to "
        f"{max(np.abs(u).max(), np.abs(v).max()):.3g} pixel; {rest:.2g} pixel of them are no shift "
        "or magnification"
    )
    finding = Finding("known-motion", message, "", "info", {"rest_pixel": rest})
    return Motion(shift_u=u, shift_v=v, magnification=magnification), (finding,)


def _scenario_of(metadata: Json) -> Path:
    """Return the scenario that metadata lead to, or one of that name beside them."""
    told = str(metadata.need("acquisition_geometry", "path_to_CTSimU_JSON").value)
    folder = metadata.path.parent
    for place in (folder / told, folder / Path(told.replace("\\", "/")).name):
        if place.is_file():
            return place
    raise InputError.at(
        metadata.path, "acquisition_geometry.path_to_CTSimU_JSON", f"{told!r}, which is not there",
        "the scenario",
    )  # fmt: skip


def _metadata_of(scenario: Path) -> Json | None:
    """Metadata beside a scenario that lead to it and have radiographs."""
    for path in sorted(scenario.parent.glob("*.json")):
        if path == scenario or not is_ctsimu(path):
            continue
        metadata = Json.read(path)
        told = metadata.get("acquisition_geometry", "path_to_CTSimU_JSON")
        if told is None or Path(str(told.value).replace("\\", "/")).name != scenario.name:
            continue
        name = metadata.get("output", "projections", "filename")
        if name is not None and _files(metadata, name, 1)[0].is_file():
            return metadata
    return None


def _files(metadata: Json, name: Json, count: int) -> list[Path]:
    """Files of frames: one, or one each where the name holds a number."""
    text, folder = str(name.value), metadata.path.parent
    if "%" not in text:
        return [folder / text]
    try:
        first = 0 if (folder / (text % 0)).is_file() else 1
        return [folder / (text % (k + first)) for k in range(count)]
    except (TypeError, ValueError):
        raise InputError.at(metadata.path, name.where, repr(text), "a name with %04d") from None


def _radiographs(metadata: Json, shape: tuple[int, int, int]) -> dict[str, Any]:
    """Frames, flats, darks and what they are."""
    output = metadata.need("output", "projections")
    header = output.get("headersize")
    of_images = 0.0 if header is None else _number(header.get("image"))
    if of_images:
        raise InputError.at(
            metadata.path, "output.projections.headersize.image", f"{of_images:g}", "0"
        )
    layout = RawLayout(
        shape=shape[1:],
        dtype=str(_or(output.get("datatype"), "uint16")),
        byteorder=str(_or(output.get("byteorder"), "little")),
        header=0 if header is None else int(_number(header.get("file"))),
    )
    white = output.get("max_intensity")
    flats, darks = (_field(metadata, output, name, layout) for name in ("flat_field", "dark_field"))
    corrected = output.get("flat_field", "projections_corrected")
    normalised = flats is None or (corrected is not None and bool(corrected.value))
    if normalised and white is None:
        where = "output.projections.max_intensity"
        raise InputError.at(metadata.path, where, "nothing", "the open beam, as there are no flats")
    files = _files(metadata, output.need("filename"), shape[0])
    common = {"frames": FrameStack([str(f) for f in files], layout)}
    if normalised and white is not None:
        return {**common, "kind": "transmission", "white": white.number()}
    return {**common, "kind": "counts", "flats": flats, "darks": darks}


def _field(metadata: Json, output: Json, name: str, layout: RawLayout) -> Frames:
    part = output.get(name)
    file = None if part is None else part.get("filename")
    if part is None or file is None:
        return None
    count = int(max(_number(part.get("number")), 1))
    return FrameStack([str(f) for f in _files(metadata, file, count)], layout)


def _number(value: Json | None) -> float:
    return 0.0 if value is None else value.number()


def _or(value: Json | None, default: Any) -> Any:
    """Return a value, be it by itself or in an object."""
    if value is None:
        return default
    return value.value.get("value", default) if isinstance(value.value, dict) else value.value


def _details(scenario: Json, direction: str) -> dict[str, str]:
    found = {
        "scenario": _or(scenario.get("file", "name"), ""),
        "description": _or(scenario.get("file", "description"), ""),
        "rotation": direction,
    }
    for key, unit in (("voltage", "kV"), ("current", "uA")):
        found[key] = f"{_or(scenario.get('source', key), '?')} {unit}"
    return {key: str(value) for key, value in found.items() if value}
