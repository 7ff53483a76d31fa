"""Print what the paper's two scans would take on clusters of several sizes, as `clra info` plans.

Nothing is measured: the speed of a GPU is predicted (half of the bound that ``gpu_limits.py``
derives for an A100), and a shared file system of 2 GB/s is assumed, 1 GB/s for a worker.
"""

import math

from clra.app.planning.cluster_plan import plans
from clra.app.planning.plan_table import cells
from clra.app.planning.planned_steps import Workers
from clra.app.speed import Speed
from clra.model.geometry import ConeBeamGeometry
from clra.model.trajectory import double_helix, space_filling

WORKERS = (1, 2, 8, 32, 128)
HEAD = (
    "| scan | work | workers | tasks | read | written | messages | time | efficiency | limited by "
    "|\n|---|---|---|---|---|---|---|---|---|---|"
)


def wood() -> ConeBeamGeometry:
    """Return the double helix of the paper's Figure 4."""
    step = 5240 * 0.139 * 2.8823 / 315.5 / 7068
    return double_helix(
        7068,
        angle_step=2 * math.pi * step / 3.4,
        z_step=step,
        source_to_axis=2.8823,
        source_to_detector=315.5,
        pixel_size=0.139,
        shape=(3040, 3040),
    )


def stone() -> ConeBeamGeometry:
    """Return the space-filling trajectory of the paper's Figure 6."""
    return space_filling(
        4858,
        z_step=5428 * 0.00293 / 4858,
        source_to_axis=7.068,
        source_to_detector=335.6,
        pixel_size=0.139,
        shape=(2304, 2304),
    )


def main() -> None:
    print(HEAD)
    for name, geometry in (("wood", wood()), ("stone", stone())):
        for count in WORKERS:
            for plan in plans(geometry, Workers.parse(f"{count}xGPU", Speed.unknown())):
                told = (name, plan.work, str(count), *cells(plan))
                print("| " + " | ".join(told) + " |")


if __name__ == "__main__":
    main()
