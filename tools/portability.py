"""Run tests on other OpenCL runtimes for CPUs, and the kernels under a checker.

``python tools/portability.py [NAME ...] [--quick]`` runs, each where it is installed:

- ``intel``: all tests on Intel's CPU runtime (wheels ``intel-opencl-rt intel-cmplr-lib-rt``);
- ``debian-pocl``: all tests on Debian's PoCL (``pocl-opencl-icd``), beside the wheel's;
- ``rusticl``: every kernel and operator on Mesa's Rusticl with llvmpipe (Debian
  ``mesa-opencl-icd``);
- ``two-devices``: every operator on either device of a context of two (PoCL);
- ``oclgrind``: every kernel, in both forms, with race detection and API checks (Debian
  ``oclgrind``); what it complains of fails;
- ``same-numbers``: every operator on all of these devices at once, to 1e-5, and Katsevich's volume
  to 1e-4.

``--quick`` leaves out what takes minutes. What cannot run is skipped with a word; the exit status
is 1 if anything failed.
"""

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
INTEL = Path(sys.prefix) / "lib" / "libintelocl.so"
RUSTICL = Path("/etc/OpenCL/vendors/rusticl.icd")
DEBIAN_POCL = Path("/etc/OpenCL/vendors/pocl.icd")
WHEELS = ("intel-opencl-rt", "intel-cmplr-lib-rt")

KERNELS = "tests/ops/test_every_kernel.py"
OPERATORS = (KERNELS, "tests/ops/test_embedding.py")
# What asks most of a device in the least time, and what finds none but this one; all tests take
# several minutes, most of them in Intel's compiler.
QUICK = (
    "tests/kernels",
    "tests/test_package.py",
    "tests/ops/projection/test_projector.py",
    "tests/ops/projection/test_projector_calls.py",
    "tests/ops/registration/test_gauss_newton.py",
    "tests/ops/filtering/test_ramp.py",
    "tests/ops/projection/test_pi_backprojector.py",
    "tests/ops/test_other_stacks.py",
    KERNELS,
)
# pyopencl and reikna ask devices for what OpenCL 1.2 does not know, and put up with the answer.
PROBING = ("Function: clGetDeviceInfo", "Error:    CL_INVALID_VALUE", "For argument 'param_name'")
DETECTED = "Oclgrind - OpenCL runtime error detected"


@dataclass(frozen=True)
class Run:
    """Tests on one runtime.

    Attributes
    ----------
    tests : tuple of str
        Files; none for all.
    missing : callable
        What there is not, or nothing.
    environment : mapping
        In which ``{icds}`` stands for a folder of the drivers named in `icds`.
    device : str
        Part of the device's name that has to be found; empty where any will do.
    """

    tests: tuple[str, ...]
    missing: Callable[[], str]
    environment: dict[str, str]
    device: str = ""
    icds: tuple[Path, ...] = ()
    command: tuple[str, ...] = ()
    more: tuple[str, ...] = field(default=())


def no_intel() -> str:
    return "" if INTEL.exists() else f"no {INTEL.name} (pip install {' '.join(WHEELS)})"


def no_debian_pocl() -> str:
    return "" if DEBIAN_POCL.exists() else f"no {DEBIAN_POCL} (Debian: pocl-opencl-icd)"


def no_rusticl() -> str:
    return "" if RUSTICL.exists() else f"no {RUSTICL} (Debian: mesa-opencl-icd)"


def no_oclgrind() -> str:
    return "" if shutil.which("oclgrind") else "no oclgrind (Debian: oclgrind)"


def neither() -> str:
    return no_intel() and no_rusticl() and f"{no_intel()}, {no_rusticl()}"


def runs(quick: bool) -> dict[str, Run]:
    rusticl = {"RUSTICL_ENABLE": "llvmpipe", "OCL_ICD_VENDORS": "{icds}"}
    return {
        "intel": Run(
            QUICK if quick else (),
            no_intel,
            {"OCL_ICD_VENDORS": "{icds}", "CLRA_DEVICE": "Intel"},
            "Intel",
            icds=(INTEL,),
        ),
        "debian-pocl": Run(
            QUICK if quick else (),
            no_debian_pocl,
            {"OCL_ICD_VENDORS": "{icds}"},
            "debian",  # the newer of the two, and so the default
            icds=(DEBIAN_POCL,),
        ),
        "rusticl": Run(
            OPERATORS,
            (lambda: "same-numbers runs every operator there") if quick else no_rusticl,
            {**rusticl, "CLRA_DEVICE": "rusticl"},
            "llvmpipe",
            icds=(RUSTICL,),
        ),
        "two-devices": Run(
            ("tests/ops/test_embedding.py",),
            lambda: "",
            {"POCL_DEVICES": "pthread pthread", "CLRA_DEVICE": "Portable Computing Language"},
            "Portable Computing Language",
            more=("-k", "two or device"),
        ),
        "oclgrind": Run(
            (KERNELS,),
            no_oclgrind,
            {"CLRA_DEVICE": ""},
            "Oclgrind",
            # Inlined, restrict becomes an LLVM intrinsic that Oclgrind 21 does not know.
            command=(
                *("oclgrind", "--data-races", "--check-api"),
                *("--build-options", "-Drestrict=", "--log", "{log}"),
            ),
        ),
        "same-numbers": Run(
            (
                "tests/ops/test_runtimes.py",
                "tests/methods/reconstruction/test_katsevich_runtimes.py",
            ),
            neither,
            rusticl,
            icds=(INTEL, RUSTICL),
        ),
    }


def run(name: str, one: Run, folder: Path) -> tuple[str, str]:
    """Run the tests; "passed", "failed" or "skipped", and a word."""
    if missing := one.missing():
        return "skipped", missing
    icds, log = folder / "icds", folder / "log"
    icds.mkdir()
    for driver in filter(Path.exists, one.icds):
        text = driver.read_text() if driver.suffix == ".icd" else f"{driver}\n"
        (icds / f"{driver.stem}.icd").write_text(text)
    environment = os.environ | {
        key: value.format(icds=icds) for key, value in one.environment.items()
    }
    prefix = [part.format(log=log) for part in one.command]
    found = subprocess.run(
        [*prefix, sys.executable, "-W", "ignore", "-c", _DEVICE],
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    ).stdout.strip()
    if one.device not in found:
        return "skipped", f"found {found or 'no device'}, expected {one.device}"
    tests = [str(ROOT / test) for test in one.tests or ("tests",)]
    # Uncaptured, as a checker's complaints in tests that pass would otherwise be lost.
    options = ["-q", "-s", "--no-header", "-p", "no:cacheprovider", *one.more]
    if len(tests) > 1 and not one.command and find_spec("xdist"):
        options += ["-n", "2", "--dist", "loadfile"]
    done = subprocess.run(
        [*prefix, sys.executable, "-P", "-m", "pytest", *options, *tests],
        env=environment,
        cwd=ROOT,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        check=False,
    )
    complaints = list(api_errors(done.stdout))
    if log.exists():
        complaints += log.read_text().splitlines()
    if done.returncode or complaints:
        print(done.stdout, *complaints, sep="\n")
        return "failed", f"{len(complaints)} complaints" if complaints else f"on {found}"
    return "passed", f"{done.stdout.strip().splitlines()[-1]}, on {found}"


_DEVICE = """
from clra.ops.runtime.devices import choose_device
device = choose_device()
print(device.name.strip(), "of", device.platform.name, device.platform.version)
"""


def api_errors(output: str) -> Iterator[str]:
    """Complaints about API calls in what Oclgrind printed, without pyopencl's probing."""
    for block in output.split(DETECTED)[1:]:
        lines = tuple(line.strip() for line in block.strip().splitlines()[:3])
        if lines != PROBING:
            yield " ".join(lines)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    known = list(runs(quick=False))
    parser.add_argument("names", nargs="*", metavar="NAME", help=", ".join(known))
    parser.add_argument("--quick", action="store_true", help="leave out what takes minutes")
    options = parser.parse_args()
    if unknown := set(options.names) - set(known):
        parser.error(f"found {', '.join(unknown)}, expected some of {', '.join(known)}")
    failed = False
    for name, one in runs(options.quick).items():
        if options.names and name not in options.names:
            continue
        start = time.perf_counter()
        with tempfile.TemporaryDirectory() as folder:
            state, word = run(name, one, Path(folder))
        print(f"{name}: {state} in {time.perf_counter() - start:.0f} s: {word}", flush=True)
        failed |= state == "failed"
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
