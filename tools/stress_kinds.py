"""The kinds of scans of the stress benchmark, by name, and how each is made from a seed.

Motions are in pixels of the detector whatever its size; drifts are below four cycles a scan.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import stress_defects
from numpy.typing import NDArray
from stress_scans import (
    Case,
    Stage,
    apparent,
    counted,
    cylinder_points,
    exposed,
    flattened,
    phantom,
    radiographs,
)

import clra

Floats = NDArray[np.float64]

_TURN = 2 * np.pi


@dataclass(frozen=True)
class Kind:
    """What a scan is like.

    Attributes
    ----------
    path : {"circle", "helix", "filling"}
        Trajectory; "filling" is a space-filling one.
    views : int
        Number of radiographs.
    arc : float
        Of a circle [degree].
    sample : {"balls", "rock", "wood"}
        Phantom.
    jitter : float
        Largest of independent shifts along u and v [pixel].
    drift : (float, float)
        Amplitude of slow shifts along u and v [pixel].
    walk : float
        Standard deviation of the steps of a random walk [pixel].
    scale : float
        Amplitude of a slow drift of the magnification.
    photons : float
        Of the open beam a pixel; 0 for no noise.
    exposures : float
        Longest exposure of a view over the shortest; `photons` is their geometric mean.
    flat : float
        Thickness of the sample along y, as a part of its width.
    wide : float
        Diameter of the sample in widths of the field of view; 0 for what fits with its motion.
    tall : float
        Height of a sample on a helix in heights that the scan covers.
    wobble : float
        Largest tilt of the sample, about the beam and across, smooth [degree].
    along : float
        Amplitude of a slow motion along the beam [percent of the field's width].
    shrink : float
        Part of its size that the sample loses during the scan.
    angle_error : float
        Standard deviation of the angles' errors [degree].
    offset : float
        Columns by which the axis is aside of where it is said to be.
    parallel : bool
        Whether the beam is parallel.
    defect : str
        Name of a function of ``stress_defects`` that spoils pixels or the reported geometry.
    strength : float
        How much of it.
    causes : tuple of str
        Codes of findings of which one names the cause.
    """

    path: str = "circle"
    views: int = 120
    arc: float = 360.0
    sample: str = "balls"
    jitter: float = 0.0
    drift: tuple[float, float] = (0.0, 0.0)
    walk: float = 0.0
    scale: float = 0.0
    photons: float = 20000.0
    exposures: float = 1.0
    flat: float = 1.0
    wide: float = 0.0
    tall: float = 1.0
    wobble: float = 0.0
    along: float = 0.0
    shrink: float = 0.0
    angle_error: float = 0.0
    offset: float = 0.0
    parallel: bool = False
    defect: str = ""
    strength: float = 0.0
    causes: tuple[str, ...] = ()

    def stage(self, size: int, random: np.random.Generator) -> Stage:
        """Return where everything really stood."""
        shape = (size if self.parallel else size * 3 // 4, size)
        index = np.arange(self.views)
        time = (index + 0.5) / self.views
        if self.path == "circle":
            stage = Stage.of(
                shape,
                index * np.radians(self.arc) / self.views
                - (np.radians(self.arc) / 2 if self.parallel else 0.0),
            )
        else:
            travel = 1.6 * shape[0] * (time - 0.5)
            step = 3.0 * _TURN / self.views if self.path == "helix" else np.radians(137.508)
            stage = Stage.of(shape, index * step, travel)
        shift = self.jitter * random.uniform(-1, 1, (self.views, 2))
        for axis, amplitude in enumerate(self.drift):
            shift[:, axis] += amplitude * _slow(time, random)
        walk = np.cumsum(random.normal(0, self.walk, (self.views, 2)), axis=0)
        shift += walk - walk.mean(axis=0)
        tilt = np.radians(self.wobble) * np.stack([_slow(time, random) for _ in range(2)], axis=1)
        error = np.radians(self.angle_error) * random.normal(size=self.views)
        return replace(
            stage,
            angle=stage.angle + error,
            shift=shift,
            magnification=1 + self.scale * _slow(time, random),
            tilt=tilt,
            along=0.01 * self.along * _slow(time, random),
            size=1 - self.shrink * time,
            offset=self.offset,
            parallel=self.parallel,
        )

    def assumed(self, size: int) -> Stage:
        """Return what the operator reports."""
        calm = replace(self, angle_error=0.0)
        return calm.stage(size, np.random.default_rng(0)).still()

    def case(self, seed: int, size: int) -> Case:
        """Return the scan of a seed."""
        random = np.random.default_rng([seed, 1])
        stage = self.stage(size, random)
        far = float(np.quantile(np.abs(stage.shift), 0.98)) / size
        width = self.wide or 2 * max(0.25, min(0.42, 0.47 - far))
        height = shape_height(stage, self.tall)
        body = flattened(phantom(self.sample, 0.5 * width, height, seed), self.flat)
        points = cylinder_points(0.5 * min(width, 1.0), height)
        assumed = self.assumed(size)
        integrals = radiographs(stage, body).astype(np.float64)
        reported, actual = assumed.geometry(), stage.geometry()
        made: dict[str, Any] = {"pixels": integrals, "kind": "line-integrals"}
        if self.photons:
            # A dark pixel counts as half a photon.
            photons = exposed(self.photons, self.exposures, self.views, seed)
            pixels = np.maximum(counted(integrals, photons, seed), 0.5 / photons)
            made = {"pixels": -np.log(pixels), "kind": "line-integrals"}
        scene = stress_defects.Scene(
            made["pixels"], made["kind"], reported, actual, seed, self.strength, assumed
        )
        if self.defect:
            scene = getattr(stress_defects, self.defect)(scene)
        truth = apparent(scene.reported, scene.actual, points)
        scan = clra.Scan(scene.pixels.astype(np.float32), scene.reported, scene.kind)
        return Case(scan, truth, points, self.causes)


def shape_height(stage: Stage, tall: float) -> float:
    """Height of the sample [mm]: on a circle within the field, on a helix all that is scanned."""
    rows = stage.shape[0] * stage.pixel
    lift = float(np.ptp(stage.height)) * stage.pixel
    return 0.72 * rows if lift == 0 else tall * (lift + 0.4 * rows)


def _slow(time: Floats, random: np.random.Generator) -> Floats:
    """Sum of sinusoids of up to four cycles a scan, within about -1 and 1."""
    cycles = np.array([0.7, 1.3, 2.2, 3.7])
    phase = random.uniform(0, _TURN, len(cycles))
    size = random.uniform(0.5, 1.0, len(cycles)) / np.sqrt(cycles)
    wave = size @ np.sin(_TURN * np.multiply.outer(cycles, time) + phase[:, None])
    wave -= wave.mean()
    return np.asarray(wave / np.abs(wave).max())


def _kinds() -> dict[str, Kind]:
    circle, helix = Kind(jitter=4.0), Kind(path="helix", views=180, jitter=4.0)
    filling = Kind(path="filling", views=180, jitter=4.0)
    slow = (4.0, 4.0)
    tilt = Kind(views=77, arc=150.0, parallel=True, sample="rock", photons=2000.0)
    kinds = {
        "circle": circle,
        "circle-240": replace(circle, views=240),
        "circle-rock": replace(circle, sample="rock"),
        "circle-wood": replace(circle, sample="wood"),
        "helix": helix,
        "helix-rock": replace(helix, sample="rock"),
        "filling": filling,
        "filling-rock": replace(filling, sample="rock"),
        "helix-drift": replace(helix, jitter=0.0, drift=slow),
        "filling-drift": replace(filling, jitter=0.0, drift=slow),
        "helix-scale": replace(helix, scale=0.002),
        "filling-scale": replace(filling, scale=0.002),
        "circle-scale": replace(circle, scale=0.002),
        "drift": Kind(drift=slow),
        "drift-u": Kind(drift=(4.0, 0.0)),
        "drift-v": Kind(drift=(0.0, 4.0)),
        "drift-rock": Kind(drift=slow, sample="rock"),
        "tilt-3": replace(tilt, walk=3.0, causes=("limited-arc",)),
        "tilt-10": replace(tilt, walk=10.0, causes=("limited-arc", "large-motion")),
        "helix-long": replace(helix, tall=1.8, causes=("axial-truncation",)),
        "beam-hardening": replace(
            circle, defect="hardened", strength=0.3, causes=("beam-hardening",)
        ),
    }
    for degrees in (200, 180, 140):
        kinds[f"arc-{degrees}"] = replace(circle, arc=float(degrees), causes=("limited-arc",))
    for pixels in (1, 10, 20, 30, 60):
        kinds[f"jitter-{pixels}"] = replace(
            circle, jitter=float(pixels), causes=("large-motion", "truncation")
        )
    large = ("large-motion", "truncation", "magnification")
    kinds["drift-30"] = Kind(drift=(30.0, 10.0), causes=large)
    for views in (9, 21, 60, 240):
        kinds[f"still-{views}"] = Kind(views=views, causes=("few-views",))
    for views in (21, 30, 60):
        kinds[f"views-{views}"] = replace(circle, views=views, causes=("few-views",))
    for photons in (50, 200, 1000, 5000):
        kinds[f"photons-{photons}"] = replace(circle, photons=float(photons), causes=("noise",))
    kinds["exposures"] = replace(circle, photons=200.0, exposures=100.0)
    kinds["exposures-helix"] = replace(helix, photons=200.0, exposures=100.0)
    kinds["plate"] = replace(circle, flat=0.25, sample="rock", photons=1000.0)
    for wide in (1.0, 1.2, 1.5, 2.0):
        kinds[f"wide-{wide}"] = replace(circle, wide=wide, sample="rock", causes=("truncation",))
    unmodelled = ("unmodelled-motion",)
    for degrees in (0.1, 0.5, 2.0):
        kinds[f"wobble-{degrees}"] = replace(circle, wobble=degrees, causes=unmodelled)
    for degrees in (0.1, 0.5):
        kinds[f"angles-{degrees}"] = replace(circle, angle_error=degrees, causes=unmodelled)
    kinds["along-beam"] = replace(circle, along=2.0, causes=unmodelled)
    kinds["shrinking"] = replace(circle, shrink=0.02, causes=unmodelled)
    for name, defect, strength, cause in _DEFECTS:
        kinds[name] = replace(circle, defect=defect, strength=strength, causes=cause)
    kinds["wrong-rows"] = replace(helix, defect="rows_reversed", causes=("row-order",))
    kinds["wrong-turn-helix"] = replace(helix, defect="opposite_sense", causes=("rotation-sense",))
    kinds["axis-offset"] = replace(circle, offset=6.0)
    kinds["axis-offset-half"] = replace(circle, arc=180.0, offset=6.0, causes=("axis-offset",))
    return kinds


_DEFECTS: tuple[tuple[str, str, float, tuple[str, ...]], ...] = (
    ("dead-column", "dead_columns", 1.0, ("bad-pixels",)),
    ("dead-columns", "dead_columns", 3.0, ("bad-pixels",)),
    ("hot-pixels", "hot_pixels", 0.005, ("bad-pixels",)),
    ("foreign-views", "foreign_views", 3.0, ("rejected-views",)),
    ("beam-decay", "beam_decay", 0.3, ("beam-decay", "intensity")),
    ("clipped", "clipped", 0.4, ("clipped-detector",)),
    ("saturated", "saturated", 0.7, ("clipped-detector",)),
    ("half-fan", "half_fan", 0.0, ("half-fan", "truncation")),
    ("wrong-turn", "opposite_sense", 0.0, ("rotation-sense",)),
    ("transposed", "transposed", 0.0, ("transposed",)),
    ("doubled-angles", "angles_scaled", 2.0, ("angle-scale",)),
    ("halved-angles", "angles_scaled", 0.5, ("angle-scale",)),
    ("angles-as-radians", "angles_scaled", 180 / np.pi, ("angle-scale",)),
    ("pixel-unit", "pixel_scaled", 2.0, ("pixel-size",)),
    ("counts", "as_counts", 20000.0, ("counts",)),
)

KINDS: dict[str, Kind] = _kinds()
