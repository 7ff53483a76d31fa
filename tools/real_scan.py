"""Shifts injected into a real synchrotron scan, found by the default alignment.

``python tools/real_scan.py -o FOLDER --seeds 1 2 3`` moves the radiographs of Savu's test scan
(Diamond Light Source, 91 views of 135 x 160 over half a turn of a parallel beam) by up to 6 pixels
along u and v ("random"), or by a slow drift of as much with jitter of 1 pixel and a magnification
that drifts by 0.05 % ("smooth"), aligns them, and writes FOLDER/real_scan.json, an entry a seed as
soon as it is there; started again it goes on where it was stopped. The frames are those of
``dls_24737/image_test`` in the folder CLRA_TEST_DATA, or of ``--frames``. The scan itself moves a
little: it is aligned first with no shift added, and what is found in v is taken off. Errors are
means of absolute values [pixel], without what the data cannot see in a parallel beam: a constant in
v; a constant, a cosine and a sine of the angle in u.
"""

import argparse
import json
import os
import sys
import tempfile
import time
import warnings
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

import clra
from clra.io.frames.frame_import import import_frames

Floats = NDArray[np.float64]

MOTIONS = ("random", "smooth")
SHIFT = 6.0
"""Largest injected shift [pixel]."""
# Of the smooth motion: jitter [pixel] and drift of the magnification.
_JITTER, _SCALE = 1.0, 5e-4


def scan_of(folder: Path) -> clra.Scan:
    """Return the scan that the folder of frames holds, in memory."""
    with tempfile.TemporaryDirectory() as place:
        path = Path(place) / "scan.nxs"
        import_frames(
            path,
            str(folder / "tiffs" / "*.tiff"),
            "-88.2:91.8:91",
            parallel=True,
            detector_distance=10.0,
            pixel_size=1.0,
            flats=folder / "flat_00001.tiff",
            darks=folder / "dark_00001.tiff",
            centre_offset=6.25,
        )
        read = clra.read_scan(path)
        return clra.Scan(read.read(0, read.views), read.geometry)


def injected(views: int, seed: int, *, smooth: bool) -> clra.Motion:
    """Return the motion of a seed."""
    random = np.random.default_rng(seed)
    if not smooth:
        u, v = random.uniform(-SHIFT, SHIFT, (2, views))
        return clra.Motion(shift_u=u, shift_v=v)
    time_ = np.linspace(0, 2 * np.pi, views)
    phase = random.uniform(0, 2 * np.pi, 3)
    u, v, m = (np.sin(cycles * time_ + p) for cycles, p in zip((1.3, 0.8, 1.1), phase, strict=True))
    jitter = random.uniform(-_JITTER, _JITTER, (2, views))
    return clra.Motion(
        shift_u=SHIFT * u + jitter[0], shift_v=SHIFT * v + jitter[1], magnification=1 + _SCALE * m
    )


def moved(scan: clra.Scan, motion: clra.Motion) -> clra.Scan:
    """Return the scan with each radiograph resampled, by a cubic spline."""
    images = []
    middle = (np.array(scan.geometry.shape) - 1) / 2
    for image, u, v, m in zip(scan.read(0, scan.views), *motion.columns(), strict=True):
        offset = middle - (middle + np.array([v, u])) / m
        images.append(ndimage.affine_transform(image, [1 / m] * 2, offset, order=3, mode="nearest"))
    return clra.Scan(np.stack(images), scan.geometry)


def errors(scan: clra.Scan, found: clra.Motion, truth: clra.Motion) -> tuple[Floats, Floats]:
    """Errors in u and v of each view, without what the data cannot see."""
    angle = np.arctan2(scan.geometry.source[:, 0], -scan.geometry.source[:, 1])
    unseen = np.stack([np.ones(scan.views), np.cos(angle), np.sin(angle)], axis=1)
    u, v = found.shift_u - truth.shift_u, found.shift_v - truth.shift_v
    return u - unseen @ np.linalg.lstsq(unseen, u, rcond=None)[0], v - v.mean()


def aligned(scan: clra.Scan, **options: Any) -> clra.Motion:
    """Align by the default schedule."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return clra.align(scan, quality=False, **options).motion


def measured(scan: clra.Scan, motion: str, seed: int | None) -> dict[str, Any]:
    """Align with the motion of a seed, or with none, and return what is wrong in each view."""
    smooth = motion == "smooth"
    truth = clra.Motion.identity(scan.views)
    if seed is not None:
        truth = injected(scan.views, seed, smooth=smooth)
    started = time.process_time()
    found = aligned(moved(scan, truth), estimate="shift+scale" if smooth else "shift")
    u, v = errors(scan, found, truth)
    seconds = round(time.process_time() - started, 1)
    return {"u": u.tolist(), "v": v.tolist(), "seconds": seconds}


def run(arguments: argparse.Namespace) -> int:
    """Run the seeds that are not there yet, and print a line each."""
    store = Path(arguments.output) / "real_scan.json"
    store.parent.mkdir(parents=True, exist_ok=True)
    entries = json.loads(store.read_text()) if store.exists() else {}
    scan = scan_of(Path(arguments.frames))
    print(
        "| motion | seed | u | v | v without the scan's own | time [s] |\n|---|---|---|---|---|---|"
    )
    for motion in arguments.motions:
        for seed in (None, *arguments.seeds):
            name = f"{motion} {'none' if seed is None else seed}"
            if name not in entries:
                entries[name] = measured(scan, motion, seed)
                fresh = store.with_suffix(".new")
                fresh.write_text(json.dumps(entries))
                fresh.replace(store)
            u, v, own = (
                np.array(entries[key][axis])
                for key, axis in ((name, "u"), (name, "v"), (f"{motion} none", "v"))
            )
            sizes = " | ".join(f"{np.abs(x).mean():.3f}" for x in (u, v, v - own))
            print(f"| {' | '.join(name.split())} | {sizes} | {entries[name]['seconds']} |")
    return 0


def main(given: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    data = Path(os.environ.get("CLRA_TEST_DATA", "."), "dls_24737", "image_test")
    parser.add_argument("-o", "--output", default="real_scan", metavar="FOLDER")
    parser.add_argument("--frames", default=str(data), metavar="FOLDER")
    parser.add_argument("--seeds", nargs="+", type=int, default=[1])
    parser.add_argument("--motions", nargs="+", choices=MOTIONS, default=MOTIONS)
    return run(parser.parse_args(given))


if __name__ == "__main__":
    sys.exit(main())
