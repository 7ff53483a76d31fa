"""What the kernels that take a GPU's time may cost: instructions a unit of work, and a roofline.

Counts are of the loop without tests, which all but the border's work-items run (``INSIDE``), with
sizes as constants, as the operators build them. A unit is a voxel-view, a sample of a ray or a
pixel. The bound of a GPU is a prediction that nothing but its table of units stands behind: clocks
of a multiprocessor for 32 units are the most of

- issue: instructions / 4,
- multiply-add: (FP32 + integer products and addresses) / (lanes / 32),
- ALU: (comparisons + other integers) / 2,
- special functions and conversions x 2,
- load wavefronts: loads x 1.3, a guess for 32 neighbours that begin anywhere.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from compilers import program, run
from gpu_usage import amd_code, grouped, nvidia_code, read_ptxas
from sass import Loop, amd_kernels, nvidia_kernels

Rates = Mapping[str, float]  # instructions a unit, by class

_UNALIGNED = 1.3


@dataclass(frozen=True)
class Gpu:
    """One GPU of an architecture: multiprocessors, boost clock [GHz], FP32 lanes of each."""

    name: str
    processors: int
    clock: float
    lanes: int


GPUS = {
    "sm_80": Gpu("A100", 108, 1.41, 64),
    "sm_89": Gpu("RTX 4090", 128, 2.52, 128),
    "sm_90": Gpu("H100", 132, 1.755, 128),
}


@dataclass(frozen=True)
class Limit:
    """What one kernel may cost.

    Attributes
    ----------
    file, kernel : str
        Which.
    name : str
        For the table.
    per_unit : callable
        Makes the instructions of a unit, by class, of the kernel's loops.
    most : mapping
        Most instructions a unit: "all", a class, or classes joined by "+".
    registers : int
        Most registers.
    defines : mapping
        Beside those that the operators give.
    """

    file: str
    kernel: str
    name: str
    per_unit: Callable[[Sequence[Loop]], Rates]
    most: Mapping[str, float]
    registers: int = 64
    defines: Mapping[str, int] | None = None


def busiest(units: float) -> Callable[[Sequence[Loop]], Rates]:
    """Take the loop with the most loads, that makes so many units a turn."""

    def rates(loops: Sequence[Loop]) -> Rates:
        loop = max(loops, key=lambda one: (one.own["LOAD"], one.size))
        return _scaled(loop.own, 1 / units)

    return rates


def by_samples(loops: Sequence[Loop]) -> Rates:
    """Take the loop with the most loads, four of which make a sample."""
    loop = max(loops, key=lambda one: one.own["LOAD"])
    return _scaled(loop.own, 4 / loop.own["LOAD"])


def by_columns(voxels: int) -> Callable[[Sequence[Loop]], Rates]:
    """Take the views' loop, of whose two halves one runs, and two turns of the columns' loop."""

    def rates(loops: Sequence[Loop]) -> Rates:
        view, *_, column = sorted(loops, key=lambda one: one.size)
        half = _added(_scaled(view.own, 0.5), _scaled(view.always, 0.5))
        return _scaled(_added(half, _scaled(column.own, 2)), 1 / voxels)

    return rates


def by_rays(loops: Sequence[Loop]) -> Rates:
    """Take the views' loop, one of three gathers of it, two columns and four rays."""
    view = max((one for one in loops if one.inner), key=lambda one: one.inner)
    column = next(one for one in loops if one.inner == 1)
    ray = next(one for one in loops if not one.inner)
    third = _added(_scaled(view.own, 1 / 3), _scaled(view.always, 2 / 3))
    return _added(third, _added(_scaled(column.own, 2), _scaled(ray.own, 4)))


def _scaled(counts: Rates, factor: float) -> Rates:
    return {kind: factor * n for kind, n in counts.items()}


def _added(one: Rates, other: Rates) -> Rates:
    return {kind: one.get(kind, 0) + other.get(kind, 0) for kind in {*one, *other}}


INSIDE = {"INSIDE": 1}
LIMITS = (
    Limit(
        "backproject.cl", "backproject_axial", "back-projection, v parallel to z", busiest(16),
        {"all": 22, "LOAD": 4.3, "MUFU+CVT": 0.5, "INT64": 1.2}, defines=INSIDE,
    ),
    Limit(
        "backproject.cl", "backproject_voxels", "back-projection, any pose", busiest(16),
        {"all": 36, "MUFU": 1.2}, defines=INSIDE,
    ),
    Limit(
        "forwardproject.cl", "forward_axial", "forward, v parallel to z", by_samples,
        {"all": 22, "CVT": 0, "INT64": 2}, defines=INSIDE,
    ),
    Limit(
        "forwardproject.cl", "forward_rays", "forward, any pose", by_samples,
        {"all": 30, "CVT": 0, "INT64": 2}, defines=INSIDE,
    ),
    Limit(
        "adjoint.cl", "adjoint_axial", "adjoint, v parallel to z, 2 rows", by_columns(16),
        {"all": 56}, registers=72, defines={"INSIDE": 2},
    ),
    Limit(
        "adjoint.cl", "adjoint_axial", "adjoint, v parallel to z, 4 rows", by_columns(16),
        {"all": 72}, registers=72, defines={"INSIDE": 4},
    ),
    Limit(
        "adjoint_leaning.cl", "adjoint_leaning", "adjoint, tilted, 2 rows", by_columns(8),
        {"all": 150}, registers=96, defines={"INSIDE": 2},
    ),
    Limit(
        "adjoint_leaning.cl", "adjoint_leaning", "adjoint, tilted, 3 rows", by_columns(8),
        {"all": 150}, registers=96, defines={"INSIDE": 3},
    ),
    # Rays that advance fastest along z, and detectors turned by more than 45 degrees.
    Limit("adjoint.cl", "adjoint_voxels", "adjoint, steep", by_rays, {"all": 272}),
    Limit(
        "pi_backprojector.cl", "pi_backproject", "pi-line back-projection", busiest(8),
        {"all": 36, "MUFU+CVT": 1}, defines=INSIDE,
    ),
    Limit(
        "gauss_newton_sums.cl", "normal_equations", "registration, a pixel and iteration",
        busiest(1), {"all": 200, "LDS": 1}, registers=128,
    ),
)  # fmt: skip
# On gfx90a: instructions of the vector ALU, of 64-bit integers, and loads.
AMD_LIMITS = {"backproject_axial": {"VALU": 18, "INT64": 0, "LOAD": 2.2}}
_VALU = ("FP32", "MUFU", "CVT", "INT", "INT64")


@dataclass(frozen=True)
class Cost:
    """What one kernel costs on one device, and the limits that it breaks."""

    name: str
    device: str
    rates: Rates
    registers: int
    bound: float | None  # units a second on the named GPU
    faults: tuple[str, ...]


def costs(folder: Path, architectures: Sequence[str]) -> Iterator[Cost]:
    """Compile what there are limits for; raises Missing where a compiler is not there."""
    nvdisasm = program("nvdisasm", "pip install nvidia-cuda-nvdisasm")
    for limit in LIMITS:
        defines = {**grouped(limit.file), **(limit.defines or {})}
        for architecture in architectures:
            report = nvidia_code(limit.file, folder, architecture, defines)
            usages = read_ptxas(report, limit.file, architecture, 1 << 20)
            usage = next(one for one in usages if one.kernel.endswith(limit.kernel))
            code = run([nvdisasm, "-c", "k.cubin"], folder, output=True)
            rates = limit.per_unit(nvidia_kernels(code)[limit.kernel])
            where = f"{limit.name} on {architecture}"
            faults = [*_broken(where, rates, limit.most)]
            if usage.registers > limit.registers:
                faults.append(f"{where}: {usage.registers} registers, at most {limit.registers}")
            bound = roofline(rates, GPUS[architecture])
            yield Cost(limit.name, architecture, rates, usage.registers, bound, tuple(faults))


def amd_costs(folder: Path) -> Iterator[Cost]:
    """Count the loops of the kernels with limits for gfx90a."""
    for limit in LIMITS:
        if limit.kernel in AMD_LIMITS:
            defines = {**grouped(limit.file), **(limit.defines or {})}
            amd_code(limit.file, folder, defines, "-S", "-o", "k.s")
            loops = amd_kernels((folder / "k.s").read_text())[limit.kernel]
            rates = dict(limit.per_unit(loops))
            rates["VALU"] = sum(rates.get(kind, 0) for kind in _VALU)
            faults = _broken(f"{limit.name} on gfx90a", rates, AMD_LIMITS[limit.kernel])
            yield Cost(limit.name, "gfx90a", rates, 0, None, tuple(faults))


def _broken(where: str, rates: Rates, most: Mapping[str, float]) -> Iterator[str]:
    for kinds, limit in most.items():
        found = total(rates) if kinds == "all" else sum(rates.get(k, 0) for k in kinds.split("+"))
        if found > limit + 1e-9:
            yield f"{where}: {found:.2f} instructions a unit ({kinds}), at most {limit}"


def total(rates: Rates) -> float:
    """Instructions a unit."""
    return sum(n for kind, n in rates.items() if kind != "VALU")


def roofline(rates: Rates, gpu: Gpu) -> float:
    """Units a second that a GPU cannot exceed, by the assumptions above."""

    def of(*kinds: str) -> float:
        return sum(rates.get(kind, 0) for kind in kinds)

    clocks = max(
        total(rates) / 4,
        of("FP32", "IMAD", "INT64") / (gpu.lanes / 32),
        of("FCMP", "INT") / 2,
        of("MUFU", "CVT") * 2,
        of("LOAD", "LDS") * _UNALIGNED,
    )
    return 32 * gpu.processors * gpu.clock * 1e9 / clocks


def limits_table(found: Sequence[Cost]) -> str:
    """Markdown: a row a kernel and device."""
    kinds = ("FP32", "MUFU", "CVT", "FCMP", "INT", "IMAD", "INT64", "LOAD", "LDS")
    lines = [
        f"| kernel | device | all | {' | '.join(kinds)} | registers | bound [G/s] |",
        "|---" * (len(kinds) + 5) + "|",
    ]
    for cost in found:
        cells = [f"{cost.rates.get(kind, 0):.2f}" for kind in kinds]
        bound = "" if cost.bound is None else f"{cost.bound / 1e9:.0f} ({GPUS[cost.device].name})"
        lines.append(
            f"| {cost.name} | {cost.device} | {total(cost.rates):.1f} | {' | '.join(cells)} | "
            f"{cost.registers or ''} | {bound} |"
        )
    return "\n".join(lines)
