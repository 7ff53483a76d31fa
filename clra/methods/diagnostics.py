"""Geometries that contradict the data, and the one that fits them better.

Every hypothesis is judged alike: a coarse volume from every second view predicts the others, and
the correlation after registration counts, so that motions of some pixels do no harm.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from clra.errors import InputError
from clra.findings import Finding
from clra.methods.alignment.reprojection import registration_for, reproject_and_register
from clra.methods.alignment.result import AlignmentResult
from clra.methods.assessment.quality import Quality
from clra.methods.assessment.radiograph_checks import radiograph_findings
from clra.methods.assessment.slice_sharpness import sharpening_by_opposite_rotation
from clra.methods.reconstruction.fbp import ramp_fbp
from clra.model.detector_pose import reversed_axes
from clra.model.geometry import ConeBeamGeometry
from clra.model.grid import default_grid
from clra.model.motion import Motion
from clra.model.rotation_sense import opposite_rotation
from clra.model.sampling.angular_coverage import covered, fan_angle
from clra.model.scan import Scan
from clra.ops.streaming.multigrid import add_update
from clra.ops.streaming.radiographs import Radiographs
from clra.ops.streaming.slab_projector import constant_volume
from clra.ops.streaming.stream import Stream

Floats = NDArray[np.float64]

# Columns and views of the coarse scan, at most.
_COLUMNS, _VIEWS, _ROWS = 64, 240, 24
# Unexplained part of held-out radiographs by the better geometry, relative to the given one, below
# which it is named.
_BETTER = 0.8
# Likewise for the axis on a part of a turn: registration makes up for most of its offset. 0.81 with
# an offset of 5 % of the columns on half a turn, 0.98 to 1 without.
_BETTER_AXIS = 0.88
# Sharpening by the other sense of turning from which on the sense is doubted. On four trajectories
# with and without noise, rocks and wood: 1.3 to 2.2 where it was wrong (1.09 on 200 degrees of a
# circle), 0.4 to 0.8 where right; spheres on the axis 0.99 to 1.01, a parallel beam 1.00.
_SHARPER = 1.05
# Fan below which radiographs may fit the wrong sense so well that it takes the slices to tell. With
# 18 degrees a third of a held-out radiograph is not predicted by the wrong one.
_NARROW = math.radians(12.0)
# Part of the detector by which views have to move to be told as a cause: motions of a quarter of it
# are often found well.
_LARGE = 0.15
# Findings that are worth knowing in a good result, and the cause of a bad one.
_CAUSES = ("limited-arc", "few-views", "axial-truncation")
# Parts of the columns by which the axis may be elsewhere.
_OFFSETS = (0.02, 0.04, 0.07, 0.12, 0.25, 0.375)


@dataclass(frozen=True)
class _Hypothesis:
    """A geometry that might be the true one, and what to tell if it is."""

    code: str
    geometry: ConeBeamGeometry
    message: str
    advice: str
    transposed: bool = False


def contradicted_geometry(stream: Stream, scan: Scan) -> Finding | None:
    """Look for another geometry that the radiographs fit far better than the given one.

    Parameters
    ----------
    stream : Stream
        Device and memory budget.
    scan : Scan
        With the geometry that is doubted, and without its motion.

    Returns
    -------
    Finding or None
        What names the better one, and the option that gives it; None if there is none.
    """
    scan = scan.subset(np.unique(np.linspace(0, scan.views - 1, _VIEWS).astype(int)))
    level = 1
    while (
        scan.geometry.columns > _COLUMNS * level and min(scan.geometry.shape) >= 2 * _ROWS * level
    ):
        level *= 2
    radiographs = Radiographs(stream, scan, level)
    images = radiographs.read(slice(0, scan.views))
    own = _unexplained(stream, images, scan.geometry, level)
    best, chosen = own, None
    for hypothesis in _hypotheses(scan.geometry):
        pixels = images.swapaxes(1, 2) if hypothesis.transposed else images
        try:
            found = _unexplained(stream, pixels, hypothesis.geometry, level)
        except InputError:
            continue  # no detector sees the axis so, or the grid reaches behind the source
        # Mirrored scans fit alike: the simpler explanation comes first.
        if found < (own if chosen is None else 0.95 * best):
            best, chosen = found, hypothesis
    limit = _BETTER_AXIS if chosen is not None and chosen.code == "axis-offset" else _BETTER
    if chosen is None or best > limit * own:
        return None
    return Finding(
        chosen.code,
        f"{chosen.message}: {100 * best:.0f} % of a held-out radiograph are not predicted then, "
        f"{100 * own:.0f} % as it is",
        chosen.advice,
        "error",
        {"unexplained": own, "otherwise": best},
    )


def evidence(
    stream: Stream, scan: Scan, aligned: AlignmentResult
) -> tuple[AlignmentResult, list[Finding]]:
    """Look for what tells against an alignment, or against the scan it is of.

    Parameters
    ----------
    stream : Stream
        Device and memory budget.
    scan : Scan
        That was aligned.
    aligned : AlignmentResult
        With its quality.

    Returns
    -------
    aligned : AlignmentResult
        With the verdict "failed" where another geometry fits far better.
    findings : list of Finding
        Empty if all is well.
    """
    findings = radiograph_findings(scan)
    quality = aligned.quality
    if not isinstance(quality, Quality):
        return aligned, findings
    other = None if quality.verdict == "good" else contradicted_geometry(stream, scan)
    # Judged without its motion, a scan that moved far may seem to fit anything better; the other
    # axis counts in any case, as an alignment makes up for a wrong one.
    if other is not None and other.code != "axis-offset":
        other = other if float(other.measured["otherwise"]) < quality.residual_after else None
    if other is None and fan_angle(scan.geometry) < _NARROW:
        sharper = sharpening_by_opposite_rotation(stream, scan, aligned.motion)
        other = doubted_rotation(sharper) if sharper == sharper else None
    if other is not None:
        quality = replace(quality, verdict="failed", reasons=(other, *quality.reasons))
    if quality.verdict != "good":
        findings = [replace(f, severity="warning") if f.code in _CAUSES else f for f in findings]
        findings += [f for f in [large_motion(aligned.motion, scan.geometry)] if f is not None]
    others = [finding for finding in findings if finding not in quality.reasons]
    return replace(aligned, quality=quality), [*quality.reasons, *others]


def large_motion(motion: Motion, geometry: ConeBeamGeometry) -> Finding | None:
    """Return a finding if views moved so far that parts of the sample left the detector.

    Parameters
    ----------
    motion : Motion
        As found.
    geometry : ConeBeamGeometry
        Of the same views.
    """
    sizes = zip((motion.shift_u, motion.shift_v), geometry.shape[::-1], strict=True)
    parts = [float(np.quantile(np.abs(shift), 0.98)) / pixels for shift, pixels in sizes]
    if max(parts) < _LARGE:
        return None
    return Finding(
        "large-motion",
        f"radiographs moved by up to {100 * parts[0]:.0f} % of the detector's width and "
        f"{100 * parts[1]:.0f} % of its height: what left it is missing, and movements of the "
        "sample as a whole are not small any more",
        "correct what is known of the motion before (--start), or take a smaller sample",
        measured={"part_u": parts[0], "part_v": parts[1]},
    )


def doubted_rotation(sharpening: float, least: float = _SHARPER) -> Finding | None:
    """Return a finding if slices are sharper with the sample turning the other way.

    Parameters
    ----------
    sharpening : float
        Mean squared gradient of slices that way, relative to the sense taken.
    least : float
        From which on it is told.
    """
    if not sharpening > least:
        return None
    return Finding(
        "rotation-sense",
        f"slices are sharper by a factor of {sharpening:.2f} if the sample turns the other way, or "
        "the radiographs are mirrored",
        "try the other --rotation (cw, ccw), in Python rotation=",
        measured={"sharpening": sharpening},
    )


def _unexplained(
    stream: Stream, images: NDArray[np.float32], geometry: ConeBeamGeometry, level: int
) -> float:
    """Median part of the held-out radiographs that a volume from the others does not explain."""
    full, grid = Scan(images, geometry.binned(level)), default_grid(geometry).binned(level)
    index = np.arange(full.views)
    seen, hidden = full.subset(index[::2]), full.subset(index[1::2])
    filtered = ramp_fbp(stream, Radiographs(stream, seen, 1), seen.geometry, grid)
    volume = constant_volume(stream, grid)
    add_update(stream, volume, filtered)  # which leaves nothing negative
    radiographs = Radiographs(stream, hidden, 1)
    registered = reproject_and_register(
        stream,
        radiographs,
        volume,
        hidden.geometry,
        registration_for(stream, hidden, radiographs, first=True, magnification=False),
        magnification=np.ones(hidden.views),
        detector=hidden.geometry.shape,
        stage="looking for a better geometry",
    )
    return float(np.median(registered.unexplained))


def _hypotheses(geometry: ConeBeamGeometry) -> Iterator[_Hypothesis]:
    opposite = opposite_rotation(geometry)
    flipped, opposite_flipped = (
        reversed_axes(base, rows=True, columns=False) for base in (geometry, opposite)
    )
    yield _Hypothesis(
        "rotation-sense",
        opposite,
        "the radiographs fit a sample that turns the other way, or they are mirrored",
        "give the other --rotation (cw, ccw), in Python rotation=",
    )
    yield _Hypothesis(
        "row-order",
        flipped,
        "the radiographs fit with their rows in the other order",
        "flip the frames (clra import --flip), in Python give the other row0= (top, bottom)",
    )
    yield _Hypothesis(
        "row-order",
        opposite_flipped,
        "the radiographs fit with their rows in the other order and a sample that turns the other "
        "way",
        "rotate the frames by half a turn, or give the other --rotation and the other row0=",
    )
    for base in (geometry, opposite, flipped, opposite_flipped):
        yield _Hypothesis(
            "transposed",
            _transposed(base),
            "the radiographs fit with rows and columns exchanged",
            "transpose the frames (frames.swapaxes(1, 2)), or give --shape the right way round",
            transposed=True,
        )
    yield from _angles(geometry)
    if covered(geometry) < 2 * math.pi - 1e-6:
        yield from _offsets(geometry)
    for factor in (0.1, 0.5, 2.0, 10.0):
        yield _Hypothesis(
            "pixel-size",
            _scaled(geometry, factor),
            f"the radiographs fit pixels of {factor:g} times the size (or another distance)",
            "check the pixel size, its unit, and the distances",
        )


def _angles(geometry: ConeBeamGeometry) -> Iterator[_Hypothesis]:
    angle = np.unwrap(np.arctan2(geometry.u[:, 1], geometry.u[:, 0]))
    turned = angle - angle[0]
    candidates = [
        ("of half the size", 0.5 * turned),
        ("of twice the size", 2 * turned),
        ("in degrees, not radians", np.radians(turned)),
        ("in radians, not degrees", np.degrees(turned)),
    ]
    if np.ptp(geometry.source[:, 2]) < 1e-6 * np.median(geometry.source_to_axis):
        # Equal steps tell a wrong unit even where steps beyond half a turn have been wrapped.
        steps = np.arange(geometry.views) / geometry.views
        for name, arc in (("a full turn", 2 * math.pi), ("half a turn", math.pi)):
            candidates += [(f"spread evenly over {name}", sign * arc * steps) for sign in (1, -1)]
    for name, other in candidates:
        if np.abs(other - turned).max() >= 0.05:
            yield _Hypothesis(
                "angle-scale",
                _rotated(geometry, other - turned),
                f"the radiographs fit angles {name}",
                "check the unit of the angles, their step and the number of views a turn",
            )


def _offsets(geometry: ConeBeamGeometry) -> Iterator[_Hypothesis]:
    for part in _OFFSETS:
        for columns in (part * geometry.columns, -part * geometry.columns):
            moved = ConeBeamGeometry(
                source=geometry.source,
                detector=geometry.detector - columns * geometry.u,
                u=geometry.u,
                v=geometry.v,
                shape=geometry.shape,
            )
            yield _Hypothesis(
                "axis-offset",
                moved,
                f"the radiographs fit an axis seen about {columns:+.3g} columns from where the "
                "geometry has it",
                "give it (--centre-offset), or take a full turn, where alignment finds it",
            )


def _rotated(geometry: ConeBeamGeometry, angle: Floats) -> ConeBeamGeometry:
    """Turn each view about z."""
    c, s = np.cos(angle)[:, None, None], np.sin(angle)[:, None, None]
    x, y, z = np.split(geometry.to_astra().reshape(-1, 4, 3), 3, axis=2)
    turned = np.concatenate([c * x - s * y, s * x + c * y, z], axis=2)
    return ConeBeamGeometry.from_astra(turned.reshape(-1, 12), geometry.shape)


def _transposed(geometry: ConeBeamGeometry) -> ConeBeamGeometry:
    """Rows become columns; each keeps its step."""
    length_u, length_v = (np.linalg.norm(x, axis=1)[:, None] for x in (geometry.u, geometry.v))
    return ConeBeamGeometry(
        source=geometry.source,
        detector=geometry.detector,
        u=geometry.u * (length_v / length_u),
        v=geometry.v * (length_u / length_v),
        shape=(geometry.columns, geometry.rows),
    )


def _scaled(geometry: ConeBeamGeometry, factor: float) -> ConeBeamGeometry:
    return ConeBeamGeometry(
        source=geometry.source,
        detector=geometry.detector,
        u=geometry.u * factor,
        v=geometry.v * factor,
        shape=geometry.shape,
    )
