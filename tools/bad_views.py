"""What bad views cost the others: the paper's four scans with and without 2 % of such.

``python tools/bad_views.py -o FOLDER`` puts blank, saturated, clipped and wrong frames, the last
from at least a quarter of the scan away, into the scans of ``reproduce_figure3.py`` at a quarter of
their size (``--scale``), motions and magnifications of 1 +- 0.002, and aligns by ``auto``. For each
choice of views (``--seeds``) errors of the other views are compared with theirs in the clean scan.
"""

import argparse
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from paper_sets import SETS, errors, moved_scan

import clra

PART = 0.02
NAMES = ("gauge_free_u", "gauge_free_v", "mae_u", "mae_v", "mae_m")
HEAD = (
    "| scan | gauge-free u | gauge-free v | raw u | raw v | magnification | found |\n"
    "|---|---|---|---|---|---|---|"
)


def with_bad_views(scan: clra.Scan, seed: int) -> tuple[clra.Scan, NDArray[np.intp]]:
    """Return the scan with some views spoilt, and which, in random order."""
    random = np.random.default_rng(seed)
    pixels = np.array(scan.projections)
    views, image = len(pixels), pixels.shape[1:]
    bad = random.choice(views, round(PART * views), replace=False)
    for view in bad[0::4]:
        pixels[view] = random.normal(0.0, 0.01, image)
    for view in bad[1::4]:
        pixels[view] = random.normal(9.0, 1.0, image)
    for view in bad[2::4]:
        pixels[view] = np.minimum(pixels[view], 0.15 * pixels[view].max())
    for view in bad[3::4]:
        away = random.integers(views // 4, 3 * views // 4)
        pixels[view] = scan.projections[(view + away) % views]
    return clra.Scan(pixels, scan.geometry, truth=scan.truth), bad


def row(scan: clra.Scan, seeds: int) -> str:
    """Align with and without; errors in the clean scan, mean rise and largest."""
    clean = clra.align(scan).motion
    before, after, found, wrongly, total = [], [], 0, 0, 0
    for seed in range(seeds):
        spoilt, bad = with_bad_views(scan, seed)
        result = clra.align(spoilt)
        found += len(set(result.flagged) & set(bad.tolist()))
        wrongly += len(set(result.flagged) - set(bad.tolist()))
        total += len(bad)
        others = np.delete(np.arange(scan.views), bad)
        truth, geometry = scan.truth.subset(others), scan.geometry.subset(others)
        for kept, motion in ((before, clean), (after, result.motion)):
            kept.append(errors(motion.subset(others), truth, geometry))
    cells = []
    for name in NAMES:
        was, now = (np.array([one[name] for one in each]) for each in (before, after))
        rise = now.mean() / was.mean() - 1
        cells.append(f"{was.mean():.2g} {rise:+.1%} (at most {(now / was).max() - 1:+.0%})")
    told = f"{found} of {total}, {wrongly} wrongly"
    return f"| {scan.name} | {' | '.join(cells)} | {told} |"


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scale", type=int, default=4)
    parser.add_argument("--seeds", type=int, default=6, help="choices of bad views")
    parser.add_argument("-o", "--output", type=Path, required=True)
    options = parser.parse_args()
    options.output.mkdir(parents=True, exist_ok=True)
    print(HEAD)
    for which in SETS:
        scan = moved_scan(*which, options.scale, 0.002, options.output)
        print(row(scan, options.seeds), flush=True)


if __name__ == "__main__":
    main()
