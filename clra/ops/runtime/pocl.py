"""PoCL's compiler is told the CPU that its library of built-in functions was compiled for.

Distribution builds of PoCL ("DISTRO" in the platform's version, such as the wheel on PyPI) carry
several variants of that library. The variant is chosen by the features of the CPU, but before
PoCL 5.0 the compiler got LLVM's name of the CPU, which need not have the same features: LLVM 14
calls AMD Zen 4 "znver3", a CPU without AVX-512, while the library is the one for "skylake-avx512".
The compiler then aborts the process ("Cannot select: ... X86ISD::FILD"), vectors of 16 are passed
wrongly, or, where LLVM only knows a "generic" CPU (Zen 5), nothing builds at all (pocl issues 512
and 1049). PoCL 5.0 pairs each variant with a CPU name (pull request 1268). :func:`pair` does the
same for older ones: PoCL's device record holds a pointer to the target triple, followed by one to
the CPU's name (``llvm_target_triplet`` and ``llvm_cpu`` in pocl_cl.h of 1.0 to 4.0), and no option
or environment variable sets them. The device's version ends with both ("HSTR: pthread-...-znver3").
Debian's 3.1 has the cure and another record; its version ends with the right name.
"""

import ctypes
import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import pyopencl as cl

from clra.findings import warn

ADVICE = (
    "this PoCL does not tell its compiler the CPU that its built-in functions were compiled for, "
    "which crashes or gives wrong numbers on some CPUs, and clra finds no way to tell it: "
    "install PoCL 5.0 or newer, or pip install 'clra[intel]'"
)

# From the best to the least: the variant, the CPU that it is compiled for, and the features by
# which PoCL chooses it, as /proc/cpuinfo calls them.
_AVX = {"avx", "cx16", "popcnt"}
VARIANTS = (
    ("avx512", "skylake-avx512", {"avx512f"}),
    ("avx2", "haswell", _AVX | {"avx2", "abm", "f16c", "fma", "bmi1", "bmi2"}),
    ("avx_fma4", "bdver1", _AVX | {"xop", "fma4"}),
    ("avx_f16c", "ivybridge", _AVX | {"f16c"}),
    ("avx", "sandybridge", _AVX),
    ("sse41", "penryn", {"sse4_1", "cx16"}),
    ("ssse3", "core2", {"ssse3", "cx16"}),
    ("sse2", "x86-64", {"sse2"}),
)

_RECORD_BYTES = 2048  # the pointers were found at bytes 632 and 640 of PoCL 3.0's record
_WORD = ctypes.sizeof(ctypes.c_void_p)
_TRIPLE = re.compile(rb"x86_64-[a-z0-9_]+-linux[a-z0-9_-]*")
_CPU = re.compile(rb"[a-z][a-z0-9_.+-]{1,31}")
_names: dict[str, ctypes.Array[ctypes.c_char]] = {}  # PoCL keeps pointers to these
_preferred: str | None = None


def needs_pairing(device: cl.Device) -> bool:
    """Whether a device is one of a PoCL before 5.0 whose built-ins come in variants."""
    platform = device.platform
    release = re.search(r"PoCL (\d+)\.", platform.version)
    return (
        "Portable Computing Language" in platform.name
        and "x86_64-" in device.version
        and release is not None
        and int(release[1]) < 5
        and "DISTRO" in platform.version
    )


def build_options(devices: Sequence[cl.Device]) -> list[str]:
    """Pair PoCL's compiler with its built-ins; to be called before every build.

    Devices that need no pairing are left alone.

    Parameters
    ----------
    devices : sequence of cl.Device
        Where to build.

    Returns
    -------
    list of str
        Options for that build, a definition that nothing uses: PoCL 3.0's cache of binaries does
        not tell CPU names apart and would give out what was compiled without the pairing.

    Warns
    -----
    ClraWarning
        If a device needs the pairing and cannot have it.
    """
    names = [pair(device) for device in devices if needs_pairing(device)]
    if not all(names):
        warn("pocl", ADVICE)
    return [f"-DCLRA_POCL_CPU={name}" for name in dict.fromkeys(filter(None, names))]


def pair(device: cl.Device) -> str | None:
    """Give the compiler of a PoCL that needs it the CPU name of the built-ins PoCL will choose.

    Parameters
    ----------
    device : cl.Device
        Device, or sub-device: the records of those it is a part of are changed as well.

    Returns
    -------
    str or None
        The name; None if a record is not as expected.
    """
    name = _preferred or cpu_of_variant(cpu_flags())
    if name is None:
        return None
    records = [device]
    while records[-1].parent_device is not None:
        records.append(records[-1].parent_device)
    done = [pair_record(record.int_ptr, record.version, name) for record in records]
    return name if all(done) or device.version.strip().endswith(f"-{name}") else None


def prefer_cpu(name: str | None) -> None:
    """Give PoCL's compiler this name from now on, or again the one of the variant."""
    global _preferred
    _preferred = name


def cpu_of_variant(flags: frozenset[str]) -> str | None:
    """CPU name of the variant that PoCL chooses for a CPU of such flags; None if it has none."""
    return next((cpu for _, cpu, needed in VARIANTS if needed <= flags), None)


def covered(cpus: Sequence[str], flags: frozenset[str]) -> list[str]:
    """Those of some CPU names whose features a CPU of such flags has."""
    return [name for name in cpus for _, cpu, needed in VARIANTS if cpu == name and needed <= flags]


@cache
def cpu_flags() -> frozenset[str]:
    """Features of the CPU as Linux lists them; none elsewhere."""
    try:
        text = Path("/proc/cpuinfo").read_text(encoding="ascii", errors="replace")
    except OSError:
        return frozenset()
    line = re.search(r"^flags\s*:(.*)$", text, re.MULTILINE)
    return frozenset(line[1].split()) if line else frozenset()


def pair_record(record: int, version: str, name: str) -> bool:
    """Let a device record's CPU name be `name`.

    Parameters
    ----------
    record : int
        Address of PoCL's device record.
    version : str
        The device's version, which ends with the triple and the CPU name.
    name : str
        CPU name that LLVM knows.

    Returns
    -------
    bool
        Whether the record has that name now; False, and nothing is written, if it does not hold the
        triple and the CPU name of the version beside each other, or is not writable.
    """
    memory = _Memory.of_process()
    words = memory.readable_bytes(record, _RECORD_BYTES) // _WORD
    pointers = (ctypes.c_void_p * words).from_address(record) if words else ()
    for at in range(words - 1):
        triple, found = memory.text(pointers[at]), memory.text(pointers[at + 1])
        if not (_TRIPLE.fullmatch(triple) and _CPU.fullmatch(found)):
            continue
        if found == name.encode():
            return True
        known = version.strip().endswith(f"-{triple.decode()}-{found.decode()}")
        if known or found.decode() in _names:
            if not memory.writable(record + (at + 1) * _WORD, _WORD):
                return False
            text = _names.setdefault(name, ctypes.create_string_buffer(name.encode()))
            pointers[at + 1] = ctypes.addressof(text)  # type: ignore[index]
            return True
    return False


@dataclass(frozen=True)
class _Memory:
    """Mapped memory of this process: (start, stop, writable), each readable."""

    regions: tuple[tuple[int, int, bool], ...]

    @classmethod
    def of_process(cls) -> "_Memory":
        try:
            lines = Path("/proc/self/maps").read_text(errors="replace").splitlines()
        except OSError:
            return cls(())
        regions = []
        for line in lines:
            addresses, access = line.split()[:2]
            if access.startswith("r") and not line.endswith("[vvar]"):
                start, stop = (int(part, 16) for part in addresses.split("-"))
                regions.append((start, stop, access[1] == "w"))
        return cls(tuple(regions))

    def readable_bytes(self, address: int, most: int) -> int:
        for start, stop, _ in self.regions:
            if start <= address < stop:
                return min(most, stop - address)
        return 0

    def writable(self, address: int, size: int) -> bool:
        return any(w and a <= address and address + size <= b for a, b, w in self.regions)

    def text(self, address: int | None) -> bytes:
        """Start of the text at an address, up to its end; empty where nothing can be read."""
        size = self.readable_bytes(address, 64) if address else 0
        return ctypes.string_at(address, size).partition(b"\0")[0] if address and size else b""
