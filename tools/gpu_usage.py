"""What each kernel takes on GPUs that are not there: registers, memory, occupancy.

The registers are LLVM's, not those of the vendors' own OpenCL compilers: a guard against spills
and trends.
"""

import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from compilers import APT, clang, data, defined, program, run

from clra.ops.runtime.build import BUILD_OPTIONS

MOST_REGISTERS = 64

# How the operators run each file where the device is no CPU, see clra/ops: work-items of a group,
# and definitions.
GPU_FORMS: Mapping[str, tuple[int, Mapping[str, int]]] = {
    "adjoint.cl": (256, {"LANES": 1}),
    "backproject.cl": (256, {"LANES": 1}),
    "bandpass.cl": (32, {"LANES": 2}),
    "blur.cl": (32, {"LANES": 2}),
    "phase_correlation.cl": (64, {"LANES": 2, "GROUP": 64}),
    "coverage.cl": (64, {}),
    "fft.cl": (64, {}),
    "ramp.cl": (128, {"LANES": 2}),
    "forwardproject.cl": (256, {"LANES": 1}),
    "katsevich_filter.cl": (32, {"LANES": 2}),
    "multigrid.cl": (64, {}),
    "pi_backprojector.cl": (256, {"LANES": 1, "BLOCK": 1}),
    "pyramid.cl": (128, {"LANES": 2}),
    "gauss_newton.cl": (1, {}),
    "gauss_newton_sums.cl": (64, {"GROUP": 64}),
    "poisson.cl": (64, {}),
    "transpose.cl": (256, {"LANES": 1}),
    "warp.cl": (128, {"LANES": 2}),
}
# Kernels that run in other groups than the rest of their file.
WORK_GROUPS: Mapping[str, int] = {
    "coverage": 16,
    "halve": 32,
    "weigh_rays": 64,
    "windowed": 128,
}

# What a multiprocessor has (NVIDIA, CUDA C++ Programming Guide, table of compute capabilities).
_WARP, _WARPS, _GROUPS, _REGISTERS = 32, 64, 32, 65536
_SHARED = {"sm_80": 164 << 10, "sm_90": 228 << 10}
_RESERVED = 1 << 10  # shared memory that the driver takes of each work-group
_REGISTER_UNIT = 256  # registers are handed to warps in multiples of this

# LLVM's NVPTX back end has no code for these; NVIDIA's library libdevice has.
_LIBDEVICE = {
    "atan": 1,
    "atan2": 2,
    "cos": 1,
    "exp": 1,
    "exp2": 1,
    "hypot": 2,
    "log": 1,
    "log2": 1,
    "pow": 2,
    "sin": 1,
    "tan": 1,
}


@dataclass(frozen=True)
class Usage:
    """What one kernel takes on one device; memory in bytes, occupancy as a part of the most."""

    kernel: str
    device: str
    registers: int
    spills: int
    private: int
    local: int
    occupancy: float

    def faults(self) -> list[str]:
        """Return the limits that it breaks."""
        where = f"{self.kernel} on {self.device}"
        found = []
        if self.spills:
            found.append(f"{where}: {self.spills} bytes of spills, expected none")
        if self.registers > MOST_REGISTERS:
            found.append(f"{where}: {self.registers} registers, expected up to {MOST_REGISTERS}")
        return found


def shim() -> str:
    """Header that sends built-in functions to libdevice."""
    lines = []
    for name, count in _LIBDEVICE.items():
        given = ", ".join("xy"[:count])
        lines.append(f"float __nv_{name}f({', '.join(['float'] * count)});")
        lines.append(f"#define {name}({given}) __nv_{name}f({given})")
    return "\n".join(lines) + "\n"


def nvidia(file: str, folder: Path) -> Iterator[Usage]:
    """Compile a file to PTX and assemble it."""
    library = data(
        "nvptx64--nvidiacl.bc", ("/usr/lib/clc", "/usr/lib/llvm-19/lib/clc"), f"{APT} libclc-19"
    )
    cuda = "pip install nvidia-cuda-nvcc"
    device = data("libdevice.10.bc", ("/usr/local/cuda/nvvm/libdevice",), cuda)
    ptxas = program("ptxas", cuda)
    (folder / "libdevice.h").write_text(shim())
    for architecture, shared in _SHARED.items():
        options = ["-target", "nvptx64--nvidiacl", f"-march={architecture}", "-O3", "-S"]
        options += ["-Xclang", "-finclude-default-header", "-include", "libdevice.h"]
        for bitcode in (library, device):
            options += ["-Xclang", "-mlink-builtin-bitcode", "-Xclang", str(bitcode)]
        options += ["-Wno-linker-warnings", "-Wno-unused-command-line-argument"]
        options += [*BUILD_OPTIONS[1:], *defined(GPU_FORMS[file][1])]
        run([*clang(19, *options), "-o", "k.ptx", file], folder)
        report = run([ptxas, "-v", f"-arch={architecture}", "-o", "/dev/null", "k.ptx"], folder)
        yield from read_ptxas(report, file, architecture, shared)


def read_ptxas(report: str, file: str, architecture: str, shared: int) -> Iterator[Usage]:
    """Resources in ptxas's words."""
    for part in report.split("Compiling entry function ")[1:]:
        kernel = part.split("'")[1]
        private, stores, loads, registers, local = (
            int(found.group(1)) if (found := re.search(pattern, part)) else 0
            for pattern in (
                r"(\d+) bytes stack frame",
                r"(\d+) bytes spill stores",
                r"(\d+) bytes spill loads",
                r"Used (\d+) registers",
                r"(\d+) bytes smem",
            )
        )
        yield Usage(
            f"{file} {kernel}",
            architecture,
            registers,
            stores + loads,
            private,
            local,
            occupancy(registers, local, WORK_GROUPS.get(kernel, GPU_FORMS[file][0]), shared),
        )


def occupancy(registers: int, local: int, work_items: int, shared: int) -> float:
    """Part of the warps of an NVIDIA multiprocessor that can be in flight.

    Parameters
    ----------
    registers : int
        Of a work-item.
    local : int
        Bytes of local memory of a work-group.
    work_items : int
        In a work-group.
    shared : int
        Bytes of shared memory of the multiprocessor.
    """
    warps = math.ceil(work_items / _WARP)
    unit = _REGISTER_UNIT * math.ceil(max(1, registers) * _WARP / _REGISTER_UNIT)
    groups = min(
        _GROUPS, _WARPS // warps, _REGISTERS // unit // warps, shared // (local + _RESERVED)
    )
    return groups * warps / _WARPS


def amd(file: str, folder: Path) -> Iterator[Usage]:
    """Compile a file for gfx90a; LLVM says what its kernels take."""
    bitcode = data(
        "bitcode",
        ("/usr/lib/x86_64-linux-gnu/amdgcn", "/opt/rocm/amdgcn"),
        f"{APT} rocm-device-libs",
    )
    options = ["-target", "amdgcn-amd-amdhsa", "-mcpu=gfx90a", "-mcode-object-version=4", "-O3"]
    options += [f"--rocm-device-lib-path={bitcode}", "-Rpass-analysis=kernel-resource-usage"]
    options += [*BUILD_OPTIONS[1:], *defined(GPU_FORMS[file][1])]
    report = run([*clang(19, *options), "-c", "-o", "/dev/null", file], folder)
    yield from read_remarks(report, file)


def read_remarks(report: str, file: str) -> Iterator[Usage]:
    """Resources in the words of LLVM's remarks."""
    for part in report.split("Function Name: ")[1:]:
        values = {name: int(n) for name, n in re.findall(r"remark: +(\w[^:]*): (\d+) \[-R", part)}
        yield Usage(
            f"{file} {part.split()[0]}",
            "gfx90a",
            values["VGPRs"] + values["AGPRs"],
            # in registers, of 4 bytes
            4 * (values["SGPRs Spill"] + values["VGPRs Spill"]),
            values["ScratchSize [bytes/lane]"],
            values["LDS Size [bytes/block]"],
            values["Occupancy [waves/SIMD]"] / 8,
        )
