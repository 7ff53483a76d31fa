"""Make the README's picture: ``python tools/make_picture.py FOLDER tools/picture.png``.

FOLDER is what ``clra demo --output FOLDER`` wrote.
"""

import sys
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np

import clra
from clra.io.volumes.volume_files import read_volume

INK, BLUE, ORANGE = "#1f2933", "#0072b2", "#d55e00"


def main(folder: Path, target: Path) -> None:
    scan = clra.read_scan(folder / "scan.nxs")
    found, truth = clra.read_alignment(folder / "motion.h5").motion, scan.truth
    assert truth is not None  # a simulated scan
    plt.rcParams.update({"font.size": 8, "text.color": INK, "axes.edgecolor": INK})
    figure, axes = plt.subplots(
        1, 3, figsize=(9.2, 2.9), width_ratios=(1, 1, 1.25), layout="constrained"
    )
    volumes = [read_volume(folder / f"{name}.h5") for name in ("before", "after")]
    middle = volumes[1][0].shape[0] // 2
    low, high = np.percentile(volumes[1][0][middle], (1, 99.7))
    for axis, (volume, grid), title in zip(
        axes, volumes, ("as measured", "aligned by clra"), strict=False
    ):
        axis.imshow(volume[middle], cmap="gray", vmin=low, vmax=high, origin="lower")
        axis.set_title(title)
        axis.set_axis_off()
        length = 0.2 / grid.voxel_size
        axis.plot([8, 8 + length], [8, 8], color="white", lw=2)
        axis.text(8 + length / 2, 11, "0.2 mm", color="white", ha="center", va="bottom")
    views = np.arange(scan.views)
    for name, colour in (("shift_u", BLUE), ("shift_v", ORANGE)):
        label = f"{name[-1]}: put in (line), found (dots)"
        axes[2].plot(views, getattr(truth, name), color=colour, lw=0.5, alpha=0.6)
        axes[2].plot(views, getattr(found, name), ".", ms=2, color=colour, label=label)
    axes[2].set(xlabel="view", ylabel="shift [pixel]", xlim=(0, 120))
    axes[2].legend(loc="upper center", ncols=2, fontsize=6.5, frameon=False)
    low, high = axes[2].get_ylim()
    axes[2].set_ylim(low, high + 3)
    figure.savefig(target, dpi=130)


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
