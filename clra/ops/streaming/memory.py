"""Memory budgets: what is taken on a device, and arrays that go to disk where the host is full."""

import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyopencl as cl
from numpy.typing import NDArray

from clra.errors import DeviceError, InputError
from clra.ops.runtime.profile import DeviceProfile, profile_of

Floats = NDArray[np.float32]


class DeviceMemoryError(DeviceError):
    """Work that does not fit on the device; the message says what would."""


def host_memory() -> int:
    """Bytes of memory that this machine has free for us (Linux; elsewhere 4 GiB)."""
    try:
        for line in Path("/proc/meminfo").read_text(encoding="ascii").splitlines():
            if line.startswith("MemAvailable:"):
                return int(line.split()[1]) << 10
    except OSError:
        pass
    return 4 << 30


# Radiographs in flight at once. Large enough that launching costs nothing beside computing, small
# enough that the few of them (measured, filtered, simulated) are no burden on a laptop; at half or
# twice the size the time of an iteration is the same within 3 %. Of large detectors at least so
# many views that reading and writing the volume for them costs little.
_CHUNK_BYTES, _CHUNK_VIEWS = 96 << 20, 8
# Pieces in which arrays are copied that are not copied whole.
_PIECE_BYTES = 32 << 20


@dataclass(frozen=True)
class Budgets:
    """How the memory that may be used is shared out [bytes].

    On the device a third is a slab of the volume, a quarter what operators need between their
    kernels, a quarter the radiographs of two chunks in flight, before and after an operation; the
    rest is for tables, and for radiographs that stay. On the host a quarter is for what is kept
    (radiographs, slabs), a sixth for chunks being read, of which the parts that are converted,
    checked and copied are there at once; on a CPU device the other half is the device's.

    Attributes
    ----------
    device, host : int
        In all.
    slab : int
        Part of a volume in one buffer.
    scratch : int
        Of one operator.
    kept : int
        Arrays that stay on the host.
    piece : int
        Parts in which arrays are copied.
    profile : DeviceProfile
        Of the device.
    """

    device: int
    host: int
    slab: int
    scratch: int
    kept: int
    piece: int
    profile: DeviceProfile

    @property
    def shared(self) -> bool:
        """Whether the device works in the host's memory."""
        return self.profile.shared_memory

    @classmethod
    def of(cls, device: cl.Device, most_device: int | None, most_host: int | None) -> "Budgets":
        """Share out what may be used; by default 3/4 of the device and half of the free host."""
        for name, value in (("max_device_memory", most_device), ("max_host_memory", most_host)):
            if value is not None and value <= 0:
                raise InputError(f"{name}: found {value}, expected a positive number of bytes")
        host = most_host or host_memory() // 2
        budget = most_device or device.global_mem_size * 3 // 4
        profile = profile_of(device)
        shared = profile.shared_memory
        if shared:
            budget = min(budget, host // 2)
        return cls(
            device=budget,
            host=host,
            slab=min(device.max_mem_alloc_size, budget // 3),
            scratch=budget // 12,
            kept=host // 4,
            piece=min(_PIECE_BYTES, budget // 16, host // 64),
            profile=profile,
        )

    def chunk(self, view_bytes: int) -> int:
        """Bytes of the radiographs that are worked on at a time."""
        wanted = max(_CHUNK_BYTES, _CHUNK_VIEWS * view_bytes)
        return min(wanted, self.device // 16, self.host // 64)


def keeps(budgets: Budgets, shape: tuple[int, ...]) -> bool:
    """Whether radiographs of that shape stay on a device that has memory of its own."""
    return not budgets.shared and 4 * int(np.prod(shape)) <= budgets.device // 8


class _Counted(cl.Buffer):
    """A buffer that tells when it is let go."""

    owner: "DeviceMemory | None" = None

    def __del__(self) -> None:
        if self.owner is not None:
            self.owner.taken -= self.size


class DeviceMemory:
    """Allocator of one device that counts what it gave, and stops at a budget.

    Parameters
    ----------
    context : cl.Context
        Of the device.
    budget : int
        Bytes.

    Attributes
    ----------
    budget, taken, peak : int
        Bytes allowed, held at the moment, and held at most so far.
    """

    def __init__(self, context: cl.Context, budget: int) -> None:
        self._context = context
        self.budget = budget
        self.taken = self.peak = 0

    def __call__(self, size: int) -> cl.Buffer:
        """Return a buffer of `size` bytes.

        Raises
        ------
        DeviceMemoryError
            If that is more than the budget leaves.
        """
        if self.taken + size > self.budget:
            raise DeviceMemoryError(
                f"{_mib(self.taken + size)} of device memory are needed, "
                f"{_mib(self.budget)} are allowed: raise --max-device-memory "
                "or --max-host-memory, or use a coarser grid"
            )
        buffer = _Counted(self._context, cl.mem_flags.READ_WRITE, size)
        buffer.owner = self
        self.taken += size
        self.peak = max(self.peak, self.taken)
        return buffer


class Reused:
    """Allocator that gives the same memory again, for operators that take turns on one queue.

    Parameters
    ----------
    memory : DeviceMemory
        Where it comes from.
    """

    def __init__(self, memory: DeviceMemory) -> None:
        self._memory = memory
        self._buffer: cl.Buffer | None = None

    def __call__(self, size: int) -> cl.Buffer:
        """Return a buffer of at least `size` bytes, which others may have as well."""
        if self._buffer is None or self._buffer.size < size:
            self._buffer = self._memory(size)
        return self._buffer


class HostRoom:
    """Part of the host's budget for arrays that are kept; what does not fit goes to disk.

    Parameters
    ----------
    budget : int
        Bytes.

    Attributes
    ----------
    left : int
        Bytes not taken yet.
    """

    def __init__(self, budget: int) -> None:
        self.left = budget


class Store:
    """Host array of float32, in memory if there is room, else in an unnamed temporary file.

    The file is read and written, not mapped, so that what was touched once does not stay in the
    process; it lies where :mod:`tempfile` puts it (``TMPDIR``).

    Parameters
    ----------
    shape : tuple of int
        Of the array.
    room : HostRoom
        Where memory is taken from, and given back to when the store goes.

    Raises
    ------
    OSError
        When written, if the disk is full.
    """

    def __init__(self, shape: tuple[int, ...], room: HostRoom) -> None:
        self.shape = shape
        self._stride = 4 * int(np.prod(shape[1:], dtype=np.int64))
        size = self._stride * shape[0]
        self._memory: Floats | None = None
        self._taken, self._room = 0, room
        if size <= room.left:
            room.left -= size
            self._taken = size
            self._memory = np.empty(shape, np.float32)
        else:
            self._file = tempfile.TemporaryFile(buffering=0)
            self._file.truncate(size)

    @property
    def in_memory(self) -> bool:
        """Whether reading copies nothing."""
        return self._memory is not None

    def __del__(self) -> None:
        """Give the memory back to the room."""
        self._room.left += self._taken
        if self._memory is None:
            self._file.close()

    def read(self, start: int, stop: int, rows: slice | None = None) -> Floats:
        """Elements `start` to `stop - 1` of the first axis; not to be written to.

        Of those of three axes, some successive ones of the second, if these are given.
        """
        if self._memory is not None:
            part = self._memory[start:stop]
            return part if rows is None else np.ascontiguousarray(part[:, rows])
        if rows is None:
            part = np.empty((stop - start, *self.shape[1:]), np.float32)
            self._read_into(start * self._stride, part)
            return part
        part = np.empty((stop - start, rows.stop - rows.start, self.shape[2]), np.float32)
        for index, image in enumerate(part):
            row = (start + index) * self.shape[1] + rows.start
            self._read_into(4 * row * self.shape[2], image)
        return part

    def _read_into(self, place: int, part: Floats) -> None:
        """Fill an array from a byte of the file on."""
        view = _bytes(part)
        self._file.seek(place)
        while view:
            count = self._file.readinto(view)
            if not count:
                raise OSError(f"a temporary file in {tempfile.gettempdir()} ended early")
            view = view[count:]

    def write(self, start: int, part: Floats) -> None:
        """Replace the elements from `start` of the first axis on."""
        if self._memory is not None:
            self._memory[start : start + len(part)] = part
            return
        view = _bytes(np.ascontiguousarray(part, np.float32))
        self._file.seek(start * self._stride)
        while view:
            view = view[self._file.write(view) :]


def _bytes(array: Floats) -> memoryview:
    return array.reshape(-1).view(np.uint8).data


def _mib(size: int) -> str:
    return f"{size / (1 << 20):.4g} MiB"
