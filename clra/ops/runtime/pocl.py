"""A defect of PoCL on CPUs newer than its LLVM, and its cure.

PoCL asks LLVM for the name of the host's CPU and hands the answer to clang as ``-target-cpu``.
An LLVM that is older than the CPU answers "generic", which clang refuses: every build then fails
with "unknown target CPU 'generic'" (pocl issues 512 and 1049; seen with the PoCL 3.0 wheel,
LLVM 14, on AMD Zen 5, where nothing at all could be compiled). No option or environment variable
of PoCL 3 overrides the name, and clang takes the last ``-target-cpu``, which is PoCL's own.

The name is a C string that PoCL's device record points to. :func:`mend_cpu_name` lets it point to
the name of an older CPU whose instructions this one has. It is called only after a build failed
with exactly that message, so devices that work are never touched.
"""

import ctypes
import struct
from pathlib import Path
from typing import BinaryIO

import pyopencl as cl

SYMPTOM = "unknown target CPU 'generic'"

_RECORD_BYTES = 2048  # the pointer was found at byte 640 of PoCL 3.0's device record
_WORD = struct.calcsize("P")
# From the widest instruction set to the narrowest, each with flags that only CPUs with all of it
# have. PoCL chooses its library of built-ins by the same features: a narrower CPU than that cannot
# inline them (back-projection 0.9 G/s as haswell or znver3, 5.4 as skylake-avx512, on Zen 5), and
# passes them vectors of 16 wrongly.
_CPUS = (
    (b"skylake-avx512", {"avx2", "fma", "bmi2", "avx512f", "avx512bw", "avx512dq", "avx512vl"}),
    (b"haswell", {"avx2", "fma", "bmi2", "movbe", "f16c"}),
    (b"x86-64", set[str]()),
)
_names: dict[bytes, ctypes.Array[ctypes.c_char]] = {}  # PoCL keeps pointers to these


def mend_cpu_name(device: cl.Device) -> bool:
    """Give a PoCL device a CPU name that its compiler knows.

    Parameters
    ----------
    device : cl.Device
        Device whose builds fail with :data:`SYMPTOM`.

    Returns
    -------
    bool
        Whether a name was replaced; False on anything but PoCL on x86-64 Linux.
    """
    if "Portable Computing Language" not in device.platform.name:
        return False
    try:
        flags = _cpu_flags()
        with Path("/proc/self/mem").open("rb+", buffering=0) as memory:
            return _replace(memory, device.int_ptr, _closest_cpu(flags))
    except OSError:
        return False


def _cpu_flags() -> set[str]:
    for line in Path("/proc/cpuinfo").read_text(encoding="ascii", errors="replace").splitlines():
        if line.startswith("flags"):
            return set(line.partition(":")[2].split())
    raise OSError("not an x86 Linux")


def _closest_cpu(flags: set[str]) -> bytes:
    return next(name for name, needed in _CPUS if needed <= flags)


def _replace(memory: BinaryIO, record: int, name: bytes) -> bool:
    """Point the record's first pointer to "generic" at `name` instead."""

    def read(address: int, size: int) -> bytes:
        try:
            memory.seek(address)
            return bytes(memory.read(size))
        except (OSError, ValueError, OverflowError):  # not an address of this process
            return b""

    words = read(record, _RECORD_BYTES)
    for at in range(0, len(words) - _WORD + 1, _WORD):
        (address,) = struct.unpack_from("P", words, at)
        if address and read(address, 8) == b"generic\0":
            text = _names.setdefault(name, ctypes.create_string_buffer(name))
            memory.seek(record + at)
            memory.write(struct.pack("P", ctypes.addressof(text)))
            return True
    return False
