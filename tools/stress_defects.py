"""What spoils the scans of the stress benchmark: pixels, or the geometry that is reported."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from stress_scans import Stage

import clra

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Scene:
    """A scan in the making.

    Attributes
    ----------
    pixels : ndarray, (views, rows, columns)
        Line integrals or what `kind` says.
    kind : str
        As clra is told.
    reported, actual : ConeBeamGeometry
        What clra is told, and what is true of these pixels.
    seed : int
        Of the scan.
    strength : float
        How much is to be spoilt.
    assumed : Stage
        What `reported` was made from.
    """

    pixels: Floats
    kind: str
    reported: clra.ConeBeamGeometry
    actual: clra.ConeBeamGeometry
    seed: int
    strength: float
    assumed: Stage

    @property
    def random(self) -> np.random.Generator:
        """Random numbers of the defect."""
        return np.random.default_rng([self.seed, 5])


def hardened(scene: Scene) -> Scene:
    """See with two energies, whose attenuations are 1 +- strength times the mean."""
    low, high = ((1 + sign * scene.strength) * scene.pixels for sign in (-1, 1))
    return replace(scene, pixels=-np.log(0.5 * np.exp(-low) + 0.5 * np.exp(-high)))


def dead_columns(scene: Scene) -> Scene:
    """Make columns see always the same, as after a wrong flat field."""
    pixels = scene.pixels.copy()
    columns = pixels.shape[2]
    chosen = scene.random.choice(np.arange(columns // 5, 4 * columns // 5), int(scene.strength))
    pixels[:, :, chosen] = np.log(1e4)
    return replace(scene, pixels=pixels)


def hot_pixels(scene: Scene) -> Scene:
    """Make a part of the pixels dead or far too bright in every view."""
    pixels = scene.pixels.copy()
    bad = scene.random.random(pixels.shape[1:]) < scene.strength
    pixels[:, bad] = scene.random.choice([-1.5, 6.0], int(bad.sum()))
    return replace(scene, pixels=pixels)


def foreign_views(scene: Scene) -> Scene:
    """Take the sample out of some views, as when a shutter or stage failed."""
    pixels = scene.pixels.copy()
    bad = scene.random.choice(len(pixels), int(scene.strength), replace=False)
    pixels[bad] = 0.01 * scene.random.normal(size=(len(bad), *pixels.shape[1:]))
    return replace(scene, pixels=pixels)


def beam_decay(scene: Scene) -> Scene:
    """Let the beam lose part of its intensity, divided by the flats of the start."""
    left = 1 - scene.strength * np.linspace(0, 1, len(scene.pixels))
    return replace(scene, pixels=scene.pixels - np.log(left)[:, None, None])


def clipped(scene: Scene) -> Scene:
    """Show nothing darker than a part of the deepest attenuation."""
    deepest = float(np.quantile(scene.pixels, 0.999))
    return replace(scene, pixels=np.minimum(scene.pixels, scene.strength * deepest))


def saturated(scene: Scene) -> Scene:
    """Let the detector saturate below the open beam, in the flats as well."""
    seen = np.minimum(np.exp(-scene.pixels), scene.strength) / scene.strength
    return replace(scene, pixels=-np.log(seen))


def half_fan(scene: Scene) -> Scene:
    """Keep the middle of the detector and one side of it: a scan of half the fan."""
    columns = scene.pixels.shape[2]
    kept = slice(3 * columns // 8, columns)
    middle = 0.5 * (kept.start + kept.stop - columns)

    def part(geometry: clra.ConeBeamGeometry) -> clra.ConeBeamGeometry:
        return clra.ConeBeamGeometry(
            source=geometry.source,
            detector=geometry.detector + middle * geometry.u,
            u=geometry.u,
            v=geometry.v,
            shape=(geometry.rows, columns - kept.start),
        )

    return replace(
        scene,
        pixels=scene.pixels[:, :, kept],
        reported=part(scene.reported),
        actual=part(scene.actual),
    )


def opposite_sense(scene: Scene) -> Scene:
    """Report the other sense of rotation."""
    return replace(scene, reported=_with_angles(scene, -scene.assumed.angle))


def angles_scaled(scene: Scene) -> Scene:
    """Report angles in a wrong unit, or of another number of steps a turn."""
    return replace(scene, reported=_with_angles(scene, scene.strength * scene.assumed.angle))


def _with_angles(scene: Scene, angle: Floats) -> clra.ConeBeamGeometry:
    return replace(scene.assumed, angle=angle).geometry()


def rows_reversed(scene: Scene) -> Scene:
    """Store the rows from the other end than reported."""
    flipped = replace_rows(scene.actual)
    return replace(scene, pixels=scene.pixels[:, ::-1], actual=flipped)


def replace_rows(geometry: clra.ConeBeamGeometry) -> clra.ConeBeamGeometry:
    """Return the geometry of radiographs with their rows reversed."""
    return clra.ConeBeamGeometry(
        source=geometry.source,
        detector=geometry.detector,
        u=geometry.u,
        v=-geometry.v,
        shape=geometry.shape,
    )


def transposed(scene: Scene) -> Scene:
    """Store frames with rows and columns exchanged, and report them as they are stored."""
    rows, columns = scene.reported.shape
    reported = replace(scene.assumed, shape=(columns, rows)).geometry()
    # The pixel keeps its size.
    scale = rows / columns
    reported = clra.ConeBeamGeometry(
        source=reported.source,
        detector=reported.detector,
        u=reported.u * scale,
        v=reported.v * scale,
        shape=reported.shape,
    )
    actual = clra.ConeBeamGeometry(
        source=scene.actual.source,
        detector=scene.actual.detector,
        u=scene.actual.v,
        v=scene.actual.u,
        shape=(columns, rows),
    )
    return replace(scene, pixels=scene.pixels.transpose(0, 2, 1), reported=reported, actual=actual)


def pixel_scaled(scene: Scene) -> Scene:
    """Report a pixel size in a wrong unit."""
    g = scene.reported
    reported = clra.ConeBeamGeometry(
        source=g.source,
        detector=g.detector,
        u=g.u * scene.strength,
        v=g.v * scene.strength,
        shape=g.shape,
    )
    return replace(scene, reported=reported)


def as_counts(scene: Scene) -> Scene:
    """Hand counts of photons over as transmission."""
    return replace(scene, pixels=scene.strength * np.exp(-scene.pixels), kind="transmission")
