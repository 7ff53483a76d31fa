"""Figures 1 to 3 of the paper, from the runs of ``reproduce_figure3.py``."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from paper_sets import MOTIONS, SAMPLE, SPHERES, VIEWS, VOXEL

import clra
from clra.model.grid import VolumeGrid

COST = {"FR": 1.0, "HR": 1 / 4, "QR": 1 / 16, "ER": 1 / 64}  # of an iteration, as the paper counts
STYLES = {"4FR": "k", "1QR-1HR": "C0", "2QR-2HR": "C1", "auto": "C2"}
WIDTHS = {"paper": 1.8, "ours": 0.8}
DASHES = dict(zip(MOTIONS, ("-", "--"), strict=True))


def draw(
    runs: dict[str, Any], size: str, scans: dict[tuple[str, str], clra.Scan], path: Path
) -> None:
    """Draw the sample and motions, slices without correction, and errors against cost."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(3, 4, figsize=(15, 11), layout="constrained")
    _first(axes[0])
    for axis, ((trajectory, motion), scan) in zip(axes[1], scans.items(), strict=True):
        image = perturbed_slice(scan, path.parent)
        axis.imshow(image, cmap="gray", vmin=0, vmax=1.1 * np.quantile(image, 0.98))
        axis.set_title(f"Fig. 2: {trajectory}, {motion} motion, uncorrected", fontsize=9)
        axis.axis("off")
    plots = [(t, c) for t in dict.fromkeys(t for t, _ in scans) for c in "uv"]
    for axis, (trajectory, component) in zip(axes[2], plots, strict=True):
        for name, found in runs.items():
            start = f"{size} {trajectory} "
            motion, who, schedule, *more = (*name.removeprefix(start).split(), "", "")
            if not name.startswith(start) or who not in WIDTHS or any(more):
                continue  # of another scan, with magnification, or without a part of the solver
            colour = STYLES.get(schedule, "0.6")
            style = {"ls": DASHES[motion], "color": colour, "lw": WIDTHS[who]}
            cost = np.cumsum([COST[step["level"]] for step in found["iterations"]])
            mae = [step[f"mae_{component}"] for step in found["iterations"]]
            axis.plot(cost, mae, marker=".", ms=4, **style)
            deviation = found[f"std_{component}"]
            axis.errorbar(cost[-1], mae[-1], deviation, capsize=2, **style)
        axis.set(yscale="log", xlabel="cost, FR iterations", ylim=(3e-3, 6))
        axis.set_title(f"Fig. 3: {trajectory}, MAE in {component}, pixels", fontsize=9)
    for schedule, colour in STYLES.items():
        axes[0, 3].plot([], [], color=colour, label=schedule)
    for names, key in ((WIDTHS, "lw"), (DASHES, "ls")):
        for name, value in names.items():
            axes[0, 3].plot([], [], color="0.4", label=name, **{key: value})
    axes[0, 3].legend(title="Fig. 3", loc="center")
    figure.savefig(path, dpi=75)


def _first(axes: NDArray[Any]) -> None:
    """Figure 1: a slice of the sample, and the motions."""
    planes, columns = SAMPLE
    grid = VolumeGrid(shape=(planes // 4, 1, columns // 4), voxel_size=4 * VOXEL)
    axes[0].imshow(SPHERES.volume(grid)[:, 0], cmap="gray")
    axes[0].set_title("Fig. 1: the sample, x-z", fontsize=9)
    for axis, (name, made) in zip(axes[1:3], MOTIONS.items(), strict=True):
        moved = made(VIEWS, seed=1)
        axis.plot(moved.shift_u, lw=0.4, label="u")
        axis.plot(moved.shift_v, lw=0.4, label="v")
        axis.set_title(f"Fig. 1: {name} motion, pixels", fontsize=9)
    for axis in axes[[0, 3]]:
        axis.axis("off")


def perturbed_slice(scan: clra.Scan, folder: Path) -> NDArray[np.float32]:
    """Return the x-y slice through the middle sphere, motion ignored; kept in the folder."""
    path = folder / f"{scan.name}-slice.npy"
    if not path.exists():
        columns = SAMPLE[1] * scan.geometry.columns // 512
        grid = VolumeGrid(shape=(1, columns, columns), voxel_size=VOXEL * SAMPLE[1] / columns)
        np.save(path, clra.reconstruct(scan, grid=grid)[0])
    return np.load(path)
