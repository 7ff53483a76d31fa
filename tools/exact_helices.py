"""Katsevich's method against ramp-FBP on helices: accuracy where phantoms are flat, and time.

``python tools/exact_helices.py`` takes a minute and prints the README's Markdown table. Radiographs
are closed forms, of helices whose views look 7 and 21 degrees up and down. Errors are relative to
the largest attenuation: of the mean, root mean square, and the largest of the mean errors of the
rings about the axis and of the phases of the helix. The last column is the time of Katsevich's
method over that of ramp-FBP on the same grid, medians of three in turn.
"""

import math
import time
from collections.abc import Iterator

import numpy as np
from scipy import ndimage

import clra
from clra.methods.reconstruction.fbp import ramp_fbp
from clra.methods.reconstruction.katsevich import katsevich
from clra.model.grid import VolumeGrid
from clra.model.phantoms.ellipsoids import Ellipsoids, three_spheres
from clra.ops.streaming.radiographs import Radiographs
from clra.ops.streaming.stream import Stream

SOURCE_TO_AXIS, SOURCE_TO_DETECTOR, FIELD, COLUMNS = 3.0, 6.0, 1.05, 160  # mm; FIELD is a radius
PHANTOMS = {
    "ellipsoids": Ellipsoids(
        [[0, 0, 0], [0.3, 0.2, 0.05], [-0.35, -0.1, -0.1], [0, -0.5, 0.1]],
        [[0.85, 0.8, 0.85], [0.25, 0.2, 0.3], [0.2, 0.25, 0.2], [0.15, 0.15, 0.2]],
        [1.0, 0.5, -0.6, 1.0],
    ),
    "three spheres": three_spheres(1.0, 6.0),
}
HELICES = {7: (1.0, 256), 21: (3.0, 384)}  # half-cone in degrees: pitch [mm], views a turn
GRID = VolumeGrid(shape=(100, 100, 100), voxel_size=0.02)
METHODS = (katsevich, ramp_fbp)
HEAD = (
    "| phantom, half-cone | mean | rms | ring | phase | time |\n|---|---|---|---|---|---|\n"
    "| | Katsevich / ramp-FBP | | | | ratio |"
)


def helix(pitch: float, views_a_turn: int) -> clra.ConeBeamGeometry:
    """Return a helix that holds the grid, with a detector just tall enough."""
    tangent = math.tan(math.asin(FIELD / SOURCE_TO_AXIS))
    pixel = 2 * SOURCE_TO_DETECTOR * tangent / COLUMNS
    slope = pitch / (2 * math.pi * SOURCE_TO_AXIS)
    top = slope * (1 + tangent**2) * (math.pi / 2 + math.atan(tangent)) * SOURCE_TO_DETECTOR
    return clra.helix(
        int((2.6 / pitch + 1.3) * views_a_turn) + 1,
        angle_step=2 * math.pi / views_a_turn,
        z_step=pitch / views_a_turn,
        source_to_axis=SOURCE_TO_AXIS,
        source_to_detector=SOURCE_TO_DETECTOR,
        pixel_size=pixel,
        shape=(2 * math.ceil(top / pixel + 1) + 1, COLUMNS),
    )


def errors(volume: np.ndarray, truth: np.ndarray, pitch: float) -> Iterator[float]:
    """Yield error of the mean, rms, and the largest mean error of a ring and of a phase."""
    flat = ndimage.maximum_filter(truth, 7) - ndimage.minimum_filter(truth, 7) < 1e-6
    flat &= truth > 0
    error = (volume - truth)[flat] / truth.max()
    yield error.mean()
    yield np.sqrt(np.mean(error**2))
    x, y, z = GRID.coordinates()
    ring = np.hypot(x, y[:, None]) / GRID.voxel_size + 0 * z[:, None, None]
    phase = 24 * (z / pitch % 1)[:, None, None] + 0 * ring
    for part in (ring[flat].astype(int), phase[flat].astype(int)):
        count = np.bincount(part)
        enough = count > 300
        means = np.bincount(part, error)[enough] / count[enough]
        yield np.abs(means - error.mean()).max()


def main() -> None:
    """Print the table."""
    stream = Stream()
    print(HEAD)
    for half_cone, (pitch, views_a_turn) in HELICES.items():
        geometry = helix(pitch, views_a_turn)
        for name, phantom in PHANTOMS.items():
            scan = clra.Scan(phantom.line_integrals(geometry), geometry)
            radiographs = Radiographs(stream, scan, 1)
            truth = phantom.volume(GRID)
            found, seconds = {}, {method: [] for method in METHODS}
            for _ in range(4):
                for method in METHODS:
                    started = time.perf_counter()
                    volume = method(stream, radiographs, geometry, GRID)
                    stream.queue.finish()
                    seconds[method].append(time.perf_counter() - started)
                    found[method] = volume
            shown = [list(errors(found[m].to_host(), truth, pitch)) for m in METHODS]
            cells = [
                f"{100 * a:+.3f} / {100 * b:+.1f} %"
                if k == 0
                else f"{100 * a:.3f} / {100 * b:.1f} %"
                for k, (a, b) in enumerate(zip(*shown, strict=True))
            ]
            ratio = np.median(seconds[katsevich][1:]) / np.median(seconds[ramp_fbp][1:])
            print(
                f"| {name}, {half_cone} degrees, {views_a_turn} views a turn | "
                f"{' | '.join(cells)} | {ratio:.2f} |",
                flush=True,
            )


if __name__ == "__main__":
    main()
