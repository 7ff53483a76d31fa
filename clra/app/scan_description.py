"""What a scan is, in the words and units of a microscopist."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from clra.io.scanners.scanner_scan import ScannerScan
from clra.model.geometry import ConeBeamGeometry
from clra.model.grid import default_grid
from clra.model.scan import Scan

Floats = NDArray[np.float64]

Kind = Literal["circular", "helix", "double helix", "space-filling", "irregular"]

# Part of the steps that have to agree with their median before a scan is called regular, and how
# well: real stages jitter, and a few frames are always missing.
_REGULAR, _STEP_TOLERANCE = 0.95, 0.02


@dataclass(frozen=True)
class Path:
    """How the source went round the sample.

    Attributes
    ----------
    kind : str
        "circular", "helix", "double helix", "space-filling" or "irregular"; a guess.
    angle_step_deg : float
        From view to view, of either sign.
    z_step_mm : float
        Of the source from view to view.
    turns : float
        Views times angle step.
    pitch_mm : float
        Travel along z in a turn.
    travel_mm : float
        From the lowest to the highest position of the source.
    """

    kind: Kind
    angle_step_deg: float
    z_step_mm: float
    turns: float
    pitch_mm: float
    travel_mm: float


def path_of(geometry: ConeBeamGeometry) -> Path:
    """Guess the trajectory from the positions of the source.

    Parameters
    ----------
    geometry : ConeBeamGeometry
        Of the scan.
    """
    x, y, z = geometry.source.T
    turned = (np.diff(np.arctan2(x, -y)) + np.pi) % (2 * np.pi) - np.pi
    raised = np.diff(z)
    # The second of two helices may run backwards: the first one's steps tell.
    half = -(-len(turned) // 2)
    angle_step = float(np.median(turned[:half])) if half else 0.0
    z_step = float(np.median(raised[:half])) if half else 0.0
    return Path(
        kind=_kind(geometry, turned, raised, angle_step, z_step) if half else "irregular",
        angle_step_deg=math.degrees(angle_step),
        z_step_mm=z_step,
        turns=geometry.views * abs(angle_step) / (2 * np.pi),
        pitch_mm=abs(z_step * 2 * np.pi / angle_step) if angle_step else 0.0,
        travel_mm=float(np.ptp(z)),
    )


def _kind(
    geometry: ConeBeamGeometry, turned: Floats, raised: Floats, angle_step: float, z_step: float
) -> Kind:
    if not _steady(np.abs(turned), abs(angle_step)):
        return "irregular"
    pixel = float(np.median(np.linalg.norm(geometry.v, axis=1)))
    level = 0.5 * pixel * float(np.median(geometry.source_to_axis / geometry.source_to_detector))
    if np.ptp(geometry.source[:, 2]) < level:
        return "circular"
    half = len(raised) // 2
    if _steady(raised[:half], z_step) and _steady(raised[half + 1 :], -z_step):
        return "double helix"
    if not _steady(raised, z_step):
        return "irregular"
    radius = float(np.median(np.hypot(*geometry.source[:, :2].T)))
    return "helix" if _next_is_nearest(radius * angle_step, z_step, radius) else "space-filling"


def _next_is_nearest(along: float, z_step: float, radius: float) -> bool:
    """Whether the source was nowhere nearer to a position than in the view after it.

    That is so on a helix. A space-filling trajectory comes back beside it some turns later.
    """
    turns = np.arange(1, 2 + int(np.hypot(along, z_step) / abs(z_step)))
    around = 2 * np.pi * radius
    aside = (turns * along + around / 2) % around - around / 2
    return bool(np.argmin(np.hypot(aside, turns * z_step)) == 0)


def _steady(steps: Floats, middle: float) -> bool:
    """Whether nearly all steps are about `middle`; no steps are not steady."""
    close = np.abs(steps - middle) <= max(_STEP_TOLERANCE * abs(middle), 1e-9)
    return bool(len(steps) and close.mean() >= _REGULAR)


@dataclass(frozen=True)
class Facts:
    """What `clra info` tells of a scan; medians over the views, lengths with their unit's name.

    Attributes
    ----------
    name, kind : str
        The scan's.
    views, rows, columns : int
        Size of the data.
    pixel_mm : (float, float)
        Along u and v, on the detector.
    source_to_axis_mm, source_to_detector_mm, magnification, fan_angle_deg : float
        Of the instrument.
    path : Path
        Trajectory.
    volume_shape : (int, int, int)
        Of the default grid (nz, ny, nx).
    voxel_mm : float
        Its voxel.
    width_mm, height_mm : float
        Field of view.
    motion_known, masked : bool
        Whether the scan carries its true motion, and a mask of pixels to use.
    defects : tuple of str
        What was found in its radiographs, if they were looked at.
    """

    name: str
    kind: str
    views: int
    rows: int
    columns: int
    pixel_mm: tuple[float, float]
    source_to_axis_mm: float
    source_to_detector_mm: float
    magnification: float
    fan_angle_deg: float
    path: Path
    volume_shape: tuple[int, int, int]
    voxel_mm: float
    width_mm: float
    height_mm: float
    motion_known: bool
    masked: bool
    defects: tuple[str, ...] = ()

    @classmethod
    def of(cls, scan: Scan) -> "Facts":
        """Find out about a scan; its radiographs are not read."""
        geometry = scan.geometry
        grid = default_grid(geometry)
        nz, _, nx = grid.shape
        distance = float(np.median(geometry.source_to_axis))
        length = float(np.median(geometry.source_to_detector))
        pixel_u, pixel_v = (
            float(np.median(np.linalg.norm(steps, axis=1))) for steps in (geometry.u, geometry.v)
        )
        return cls(
            name=scan.name,
            kind=scan.kind,
            views=scan.views,
            rows=geometry.rows,
            columns=geometry.columns,
            pixel_mm=(pixel_u, pixel_v),
            source_to_axis_mm=distance,
            source_to_detector_mm=length,
            magnification=length / distance,
            fan_angle_deg=2 * math.degrees(math.atan(0.5 * geometry.columns * pixel_u / length)),
            path=path_of(geometry),
            volume_shape=grid.shape,
            voxel_mm=grid.voxel_size,
            width_mm=nx * grid.voxel_size,
            height_mm=nz * grid.voxel_size,
            motion_known=scan.truth is not None,
            masked=scan.mask is not None,
            defects=() if scan.corrections is None else tuple(map(str, scan.corrections.findings)),
        )

    def lines(self) -> dict[str, str]:
        """Return name and value of each line that describes the scan to a person."""
        pixel_u, pixel_v = map(metric, self.pixel_mm)
        path = self.path
        # The source goes round the other way than the sample turns.
        sense = "clockwise" if path.angle_step_deg > 0 else "counter-clockwise"
        steps = f"{path.kind}, {abs(path.angle_step_deg):.4g} degrees"
        turns = f" a view, {path.turns:.4g} turns of the sample {sense} from above"
        if path.kind != "circular" and path.travel_mm:
            steps += f" and {metric(path.z_step_mm)}"
            turns += f", pitch {metric(path.pitch_mm)}, travel {metric(path.travel_mm)}"
        nz, ny, nx = self.volume_shape
        known = ["the true motion (a simulation)"] * self.motion_known
        known += ["which pixels to use (a mask)"] * self.masked
        return {
            "scan": f"{self.name} ({self.kind})",
            "views": f"{self.views}",
            "detector": f"{self.rows} rows x {self.columns} columns, pixel {pixel_u} x {pixel_v}",
            **(
                {"beam": "parallel"}
                if math.isclose(
                    self.magnification, 1.0, rel_tol=1e-9
                )  # no detector stands on the axis of a cone beam
                else {
                    "distances": f"source to axis {metric(self.source_to_axis_mm)}, "
                    f"to detector {metric(self.source_to_detector_mm)}",
                    "magnification": f"{self.magnification:.4g}, "
                    f"fan angle {self.fan_angle_deg:.3g} degrees",
                }
            ),
            "trajectory": steps + turns,
            "volume": f"{nx} x {ny} x {nz} voxels of {metric(self.voxel_mm)}",
            "field of view": f"{metric(self.width_mm)} across, {metric(self.height_mm)} high",
            **({"known": " and ".join(known)} if known else {}),
            **({"defects": "; ".join(self.defects)} if self.defects else {}),
        }


def metric(millimetres: float) -> str:
    """Write a length in the unit that suits it: "4.544 um", "3.21 mm"."""
    size = abs(millimetres)
    if size >= 1000:
        return f"{millimetres / 1000:.4g} m"
    if size >= 0.5 or size == 0:
        return f"{millimetres:.4g} mm"
    return f"{millimetres * 1000:.4g} um"


def views_flagged(views: Sequence[int]) -> str:
    """Count and list views that are rejected; the motion file and --json have them all."""
    return f"{len(views)} views flagged" + (f": {listed(views, 20)}" if views else "")


def listed(numbers: Sequence[int], most: int) -> str:
    """List numbers, up to so many: "3, 17 and 2 more"."""
    more = f" and {len(numbers) - most} more" if len(numbers) > most else ""
    return f"{', '.join(map(str, numbers[:most]))}{more}"


def scanner_text(scan: ScannerScan) -> str:
    """Describe what a scanner's files hold: a table, and a line for each finding."""
    found = [f"note: {finding}" for finding in scan.findings]
    return "\n".join([table(scan.contents()), *found])


def table(lines: dict[str, str]) -> str:
    """Names and values in two columns."""
    width = max(map(len, lines)) + 2
    return "\n".join(f"{name + ':':<{width}}{value}" for name, value in lines.items())
