"""Check every kernel for GPUs on a machine without one: ``python tools/check_gpu.py``.

Compiles ``kernels/`` for NVIDIA (clang to PTX, ptxas for sm_80, sm_89 and sm_90) and AMD (gfx90a)
in the forms that the operators use on GPUs, and prints registers, spills, private memory, local
memory and occupancy. Fails on a spill, private memory, a kernel without a required work-group, or
above 64 registers but for those listed in gpu_usage.py. Counts the instructions of what takes a
GPU's time and fails above the limits of gpu_limits.py. Also holds the sources to the subset of
OpenCL C that every driver has, and validates their SPIR-V. A check whose tools are missing is
skipped with one line, an error with ``--require``.
"""

import argparse
import re
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from compilers import APT, Missing, clang, defined, program, run
from gpu_limits import GPUS, Cost, amd_costs, costs, limits_table
from gpu_usage import GPU_FORMS, Usage, amd, nvidia

from clra import kernels

# Files that only CPUs run.
CPU_ONLY = {
    f"{stem}_{form}.cl"
    for stem in ("adjoint", "backproject", "forwardproject")
    for form in ("columns", "tilted")
} | {"adjoint_steep.cl", "pi_backprojector_columns.cl"}
# What CPUs run: with AVX-512 the projectors' vectors are wider.
CPU_FORM: Mapping[str, int] = {"LANES": 8, "GROUP": 1, "BLOCK": 128}


def forms(file: str) -> tuple[Mapping[str, int], ...]:
    """As it stands alone, on GPUs and on CPUs."""
    if file in CPU_ONLY:
        return {}, CPU_FORM, CPU_FORM | {"LANES": 16}
    return {}, GPU_FORMS[file][1], CPU_FORM


def portable(file: str, folder: Path) -> Iterator[Usage]:
    """Hold a file to OpenCL C 1.2 without extensions and without double precision.

    Kernels that GPUs run have to be compiled for the work-groups that they run in.
    """
    loose = re.findall(r"^kernel void (\w+)", kernels.source(file), re.MULTILINE)
    if loose and file not in CPU_ONLY:
        raise RuntimeError(f"no work-group required of {', '.join(loose)}")
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


def limits(folder: Path) -> list[str]:
    """Print what kernels cost that there are limits for; the limits that are broken."""
    found: list[Cost] = []
    missing: Missing | None = None
    for counted in (costs(folder, list(GPUS)), amd_costs(folder)):
        try:
            found += counted
        except Missing as one:
            missing = one
    if found:
        print(limits_table(found))
    if missing is not None:
        raise missing
    return [fault for cost in found for fault in cost.faults]


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
    parser.add_argument(
        "--only", choices=[*CHECKS, "limits"], action="append", help="checks, all by default"
    )
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
        for check in given.only or [*CHECKS, "limits"]:
            try:
                if check == "limits":
                    faults += limits(folder)
                    continue
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
    checked = len(given.only or [*CHECKS, "limits"]) - skipped
    print(f"{len(files)} files, {checked} checks, {skipped} skipped, {len(faults)} failed")
    return int(bool(faults) or (given.require and skipped > 0))


if __name__ == "__main__":
    sys.exit(main())
