"""Check every kernel for GPUs on a machine without one: ``python tools/check_gpu.py``.

Compiles ``kernels/`` for NVIDIA (clang to PTX, ptxas for sm_80 and sm_90) and AMD (gfx90a) in the
forms that the operators use on GPUs, and prints registers, spills, private memory, local memory and
occupancy. Fails on a spill or above 64 registers. Also holds the sources to the subset of OpenCL C
that every driver has, and validates their SPIR-V.

The registers are LLVM's, not those of the vendors' own OpenCL compilers: a guard against spills
and trends. A check whose tools are missing is skipped with one line, an error with ``--require``.
"""

import argparse
import math
import re
import shutil
import subprocess
import sys
import sysconfig
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from clra import kernels
from clra.ops.opencl import BUILD_OPTIONS

MOST_REGISTERS = 64
APT = "apt-get install -y --no-install-recommends"

# How the operators run each file where the device is no CPU, see clra/ops: work-items of a group,
# and definitions.
GPU_FORMS: Mapping[str, tuple[int, Mapping[str, int]]] = {
    "adjoint.cl": (256, {"LANES": 1}),
    "backproject.cl": (256, {"LANES": 1}),
    "bandpass.cl": (32, {"LANES": 2}),
    "blur.cl": (32, {"LANES": 2}),
    "correlation.cl": (64, {"LANES": 2, "GROUP": 64}),
    "coverage.cl": (64, {}),
    "fft.cl": (64, {}),
    "filtering.cl": (128, {"LANES": 2}),
    "forwardproject.cl": (256, {"LANES": 1}),
    "katsevich.cl": (32, {"LANES": 2}),
    "multigrid.cl": (64, {}),
    "pibackproject.cl": (256, {"LANES": 1, "BLOCK": 1}),
    "pyramid.cl": (128, {"LANES": 2}),
    "registration.cl": (1, {}),
    "registration_sums.cl": (64, {"GROUP": 64}),
    "transmission.cl": (64, {}),
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
# Files that only CPUs run.
CPU_ONLY = {
    f"{stem}_{form}.cl"
    for stem in ("adjoint", "backproject", "forwardproject")
    for form in ("columns", "tilted")
}
# What CPUs run: with AVX-512 the projectors' vectors are wider.
CPU_FORM: Mapping[str, int] = {"LANES": 8, "GROUP": 1, "BLOCK": 128}

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


class Missing(Exception):  # noqa: N818 - not an error: the check is skipped
    """A tool is not installed; the message says how to get it."""


def program(name: str, how: str) -> str:
    """Path of a tool, on PATH or in a wheel of NVIDIA's."""
    wheels = Path(sysconfig.get_paths()["purelib"]).glob(f"nvidia/**/bin/{name}")
    found = shutil.which(name) or next(map(str, wheels), None)
    if found is None:
        raise Missing(f"no {name} ({how})")
    return found


def data(name: str, folders: Sequence[str], how: str) -> Path:
    """Path of a bitcode library or a folder of them."""
    wheels = Path(sysconfig.get_paths()["purelib"]).glob(f"nvidia/**/{name}")
    for path in (*(Path(folder) / name for folder in folders), *wheels):
        if path.exists():
            return path
    raise Missing(f"no {name} ({how})")


def clang(version: int, *options: str) -> list[str]:
    how = f"{APT} clang-{version}"
    return [program(f"clang-{version}", how), "-x", "cl", BUILD_OPTIONS[0], *options]


def run(command: Sequence[str], folder: Path) -> str:
    """Run a command in a folder; its standard error, as a RuntimeError if it fails."""
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    if done.returncode:
        raise RuntimeError(f"{Path(command[0]).name} failed:\n{done.stderr.strip()}")
    return done.stderr


def defined(form: Mapping[str, int]) -> list[str]:
    return [f"-D{name}={value}" for name, value in form.items()]


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


def forms(file: str) -> tuple[Mapping[str, int], ...]:
    """As it stands alone, on GPUs and on CPUs."""
    if file in CPU_ONLY:
        return {}, CPU_FORM, CPU_FORM | {"LANES": 16}
    return {}, GPU_FORMS[file][1], CPU_FORM


def portable(file: str, folder: Path) -> Iterator[Usage]:
    """Hold a file to OpenCL C 1.2 without extensions and without double precision."""
    options = ["-target", "spir64", "-Xclang", "-finclude-default-header"]
    options += ["-Xclang", "-cl-ext=-all", "-fsyntax-only", "-Wall", "-Wextra"]
    options += ["-Wdouble-promotion", "-Wno-unused-parameter", "-Werror"]
    options.append("-Wno-unused-function")  # a pasted header has more than a file needs
    for form in forms(file):
        run([*clang(19, *options), *defined(form), file], folder)
    yield from ()


def spirv(file: str, folder: Path) -> Iterator[Usage]:
    """Translate a file to SPIR-V 1.0 and validate it."""
    translator = program("llvm-spirv-15", f"{APT} llvm-spirv-15")
    validator = program("spirv-val", f"{APT} spirv-tools")
    options = ["-target", "spir64", "-Xclang", "-finclude-default-header", "-O0", "-emit-llvm"]
    for form in forms(file):
        run([*clang(15, *options), *defined(form), "-c", "-o", "k.bc", file], folder)
        run([translator, "--spirv-max-version=1.0", "k.bc", "-o", "k.spv"], folder)
        run([validator, "--target-env", "opencl1.2", "k.spv"], folder)
    yield from ()


CHECKS = {"portable": portable, "spirv": spirv, "nvidia": nvidia, "amd": amd}


def table(usages: Sequence[Usage]) -> str:
    """One row a kernel; what differs between the devices is given for each."""
    devices = list(dict.fromkeys(use.device for use in usages))
    lines = [
        f"| {' / '.join(devices)} | registers | spills [B] | private [B] | local [B] | occupancy |",
        "|---|---|---|---|---|---|",
    ]
    for kernel in dict.fromkeys(use.kernel for use in usages):
        of = [use for use in usages if use.kernel == kernel]
        cells = (
            [str(use.registers) for use in of],
            [str(use.spills) for use in of],
            [str(use.private) for use in of],
            [str(use.local) for use in of],
            [f"{use.occupancy:.0%}" for use in of],
        )
        merged = (values[0] if len(set(values)) == 1 else " / ".join(values) for values in cells)
        lines.append(f"| {kernel} | {' | '.join(merged)} |")
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("files", nargs="*", help="kernel files, all by default")
    parser.add_argument("--only", choices=CHECKS, action="append", help="checks, all by default")
    parser.add_argument("--require", action="store_true", help="fail where a check is skipped")
    given = parser.parse_args(arguments)
    usages: list[Usage] = []
    faults: list[str] = []
    skipped = 0
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        files = given.files or kernels.names()
        for file in files:
            (folder / file).write_text(kernels.source(file))
        known = GPU_FORMS.keys() | CPU_ONLY
        faults += [f"{file}: not in GPU_FORMS" for file in files if file not in known]
        for check in given.only or CHECKS:
            try:
                of_check = GPU_FORMS if CHECKS[check] in (nvidia, amd) else known
                for file in filter(of_check.__contains__, files):
                    try:
                        usages += CHECKS[check](file, folder)
                    except RuntimeError as error:
                        faults.append(f"{check}: {file}: {error}")
            except Missing as missing:
                skipped += 1
                print(f"{check}: skipped, {missing}")
    if usages:
        print(table(usages))
    faults += [fault for use in usages for fault in use.faults()]
    for fault in faults:
        print(f"FAILED {fault}")
    checked = len(given.only or CHECKS) - skipped
    print(f"{len(files)} files, {checked} checks, {skipped} skipped, {len(faults)} failed")
    return int(bool(faults) or (given.require and skipped > 0))


if __name__ == "__main__":
    sys.exit(main())
