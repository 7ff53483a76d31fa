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
# Kernels that may take more, and why they are faster so.
MORE_REGISTERS = {
    "normal_equations": (128, "36 sums of a work-item stay in registers"),
    "rigid_products": (104, "36 sums of a work-item stay in registers"),
    "adjoint_axial": (72, "16 voxels share what a column of rays costs"),
    "adjoint_leaning": (96, "8 voxels share what a column of rays costs"),
}

# How the operators run each file where the device is no CPU, see clra/ops: work-items of a group,
# and definitions.
GPU_FORMS: Mapping[str, tuple[int, Mapping[str, int]]] = {
    "adjoint.cl": (256, {"VOXELS": 16, "COLUMNS": 1024}),
    "adjoint_leaning.cl": (256, {"VOXELS": 8, "COLUMNS": 1024}),
    "backproject.cl": (256, {"VOXELS": 16, "COLUMNS": 1024}),
    "bandpass.cl": (128, {"LANES": 2}),
    "blur.cl": (128, {"LANES": 2}),
    "phase_correlation.cl": (128, {"LANES": 2, "GROUP": 256}),
    "coverage.cl": (128, {}),
    "fft.cl": (64, {}),
    "ramp.cl": (128, {"LANES": 2}),
    "ramp_transform.cl": (256, {"LENGTH": 4096, "GROUP": 256}),
    "forwardproject.cl": (256, {"RAYS": 4, "COLUMNS": 1024, "NX": 1024, "NZ": 1024}),
    "katsevich_filter.cl": (128, {"LANES": 2}),
    "moments.cl": (256, {}),
    "multigrid.cl": (64, {}),
    "pi_backprojector.cl": (256, {"VOXELS": 8, "COLUMNS": 1024}),
    "pyramid.cl": (128, {"LANES": 2}),
    "gauss_newton.cl": (64, {}),
    "gauss_newton_sums.cl": (64, {"GROUP": 64}),
    "poisson.cl": (64, {}),
    "rigid_registration.cl": (64, {"LANES": 1}),
    "transpose.cl": (256, {"LANES": 1}),
    "warp.cl": (128, {"LANES": 2}),
}
# Kernels that run in other groups than the rest of their file.
WORK_GROUPS: Mapping[str, int] = {
    "normalise": 64,
    "filter_pairs": 256,
    "means": 256,
    "whiten": 256,
    "peak": 256,
}
# Two axes of the groups of that many work-items.
SHAPES = {64: (64, 1), 128: (32, 4), 256: (32, 8)}

# What a multiprocessor has (NVIDIA, CUDA C++ Programming Guide, table of compute capabilities).
_WARP, _GROUPS, _REGISTERS = 32, 32, 65536
_WARPS = 64
_SHARED = {"sm_80": 164 << 10, "sm_89": 100 << 10, "sm_90": 228 << 10}
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
        if self.private:
            found.append(f"{where}: {self.private} bytes of private memory, expected none")
        name = self.kernel.split()[-1]
        most = MORE_REGISTERS.get(name, (MOST_REGISTERS, ""))[0]
        # AMD's vector registers, of which there are twice as many, are a matter of occupancy.
        if self.registers > most and self.device.startswith("sm_"):
            found.append(f"{where}: {self.registers} registers, expected up to {most}")
        return found


def shim() -> str:
    """Header that sends built-in functions to libdevice, or to what a driver's compiler makes."""
    lines = []
    for name, count in _LIBDEVICE.items():
        given = ", ".join("xy"[:count])
        lines.append(f"float __nv_{name}f({', '.join(['float'] * count)});")
        lines.append(f"#define {name}({given}) __nv_{name}f({given})")
    lines.append("#define native_recip(x) __nvvm_rcp_approx_ftz_f(x)")
    lines.append("#define SATURATE(x) __nvvm_saturate_ftz_f(x)")
    return "\n".join(lines) + "\n"


def nvidia_code(file: str, folder: Path, architecture: str, defines: Mapping[str, int]) -> str:
    """Compile a file to PTX and assemble it to ``k.cubin``; what ptxas reports."""
    library = data(
        "nvptx64--nvidiacl.bc", ("/usr/lib/clc", "/usr/lib/llvm-19/lib/clc"), f"{APT} libclc-19"
    )
    cuda = "pip install nvidia-cuda-nvcc"
    device = data("libdevice.10.bc", ("/usr/local/cuda/nvvm/libdevice",), cuda)
    ptxas = program("ptxas", cuda)
    (folder / "libdevice.h").write_text(shim())
    options = ["-target", "nvptx64--nvidiacl", f"-march={architecture}", "-O3", "-S"]
    options += ["-Xclang", "-finclude-default-header", "-include", "libdevice.h"]
    for bitcode in (library, device):
        options += ["-Xclang", "-mlink-builtin-bitcode", "-Xclang", str(bitcode)]
    options += ["-Wno-linker-warnings", "-Wno-unused-command-line-argument"]
    # Division to 2.5 ulp and square roots to 3, as OpenCL asks for and drivers give.
    options += ["-mllvm", "-nvptx-prec-divf32=1", "-mllvm", "-nvptx-prec-sqrtf32=0"]
    options += [*BUILD_OPTIONS[1:], *defined(defines)]
    run([*clang(19, *options), "-o", "k.ptx", file], folder)
    return run([ptxas, "-v", f"-arch={architecture}", "-o", "k.cubin", "k.ptx"], folder)


def grouped(file: str) -> dict[str, int]:
    """Definitions of a file with those of its groups."""
    group, defines = GPU_FORMS[file]
    x, y = SHAPES[group]
    return {"GROUP_X": x, "GROUP_Y": y, **defines}


def nvidia(file: str, folder: Path) -> Iterator[Usage]:
    """Compile a file for each architecture."""
    for architecture, shared in _SHARED.items():
        report = nvidia_code(file, folder, architecture, grouped(file))
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


def amd_code(file: str, folder: Path, defines: Mapping[str, int], *output: str) -> str:
    """Compile a file for gfx90a; what LLVM says of its kernels."""
    bitcode = data(
        "bitcode",
        ("/usr/lib/x86_64-linux-gnu/amdgcn", "/opt/rocm/amdgcn"),
        f"{APT} rocm-device-libs",
    )
    options = ["-target", "amdgcn-amd-amdhsa", "-mcpu=gfx90a", "-mcode-object-version=4", "-O3"]
    options += [f"--rocm-device-lib-path={bitcode}", "-Rpass-analysis=kernel-resource-usage"]
    options += [*BUILD_OPTIONS[1:], *defined(defines)]
    return run([*clang(19, *options), *output, file], folder)


def amd(file: str, folder: Path) -> Iterator[Usage]:
    """Compile a file for gfx90a."""
    report = amd_code(file, folder, grouped(file), "-c", "-o", "/dev/null")
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
