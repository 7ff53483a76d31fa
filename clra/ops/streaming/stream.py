"""One device with its queue and memory budget; data on their way between it and the host.

Work is cut to fit the memory: views in chunks, volumes in z-slabs. A CPU device works on the host's
own arrays: nothing is copied that can be shared.
"""

from itertools import pairwise

import numpy as np
import pyopencl as cl
import pyopencl.array
from numpy.typing import NDArray

from clra.model.grid import VolumeGrid
from clra.ops.runtime import build
from clra.ops.runtime.devices import usable_device
from clra.ops.streaming.memory import Budgets, DeviceMemory, DeviceMemoryError, HostRoom
from clra.ops.streaming.staging import Staging
from clra.progress import Progress, ProgressCallback

Floats = NDArray[np.float32]


class Stream:
    """One device with its queue, and how much memory may be used on it and on the host.

    On a CPU device buffers lie in the host's memory: the device's budget is then a part of the
    host's, at most half of it.

    Parameters
    ----------
    device : str or cl.Device, optional
        As :func:`clra.ops.runtime.devices.usable_device` takes it.
    max_device_memory, max_host_memory : int, optional
        Bytes; by default 3/4 of the device's memory and half of what the host has available. The
        host's counts what comes on top of the imported modules and built kernels.
    report : callable, optional
        Called with a :class:`Progress` as work goes on.

    Attributes
    ----------
    memory : DeviceMemory
        Allocator for arrays and operators; it stops at the budget.
    budgets : Budgets
        How they are shared out.
    scratch_limit : int
        Bytes of scratch memory that an operator should not exceed, for those that take a limit.

    Raises
    ------
    DeviceError
        If there is no such device, or it fails the self-test.
    InputError
        If a budget is not positive.
    """

    def __init__(
        self,
        device: str | cl.Device | None = None,
        *,
        max_device_memory: int | None = None,
        max_host_memory: int | None = None,
        report: ProgressCallback | None = None,
    ) -> None:
        self.device = usable_device(device, report)
        self.context = cl.Context([self.device])
        self.queue = cl.CommandQueue(self.context)
        self._builds = build.builds(self.context)  # held: operators come and go
        budgets = Budgets.of(self.device, max_device_memory, max_host_memory)
        self.budgets = budgets
        self.scratch_limit = budgets.scratch
        self.memory = DeviceMemory(self.context, budgets.device)
        self.room = HostRoom(budgets.kept)
        self._report = report
        self._shared = budgets.shared
        # Copies to the device have a queue of their own, to run beside the kernels.
        self._copies = self.queue if self._shared else cl.CommandQueue(self.context)
        self._staging = Staging(self._copies, budgets.piece)

    def report(self, stage: str, done: int, total: int) -> None:
        """Tell the caller how far a stage is."""
        if self._report is not None:
            self._report(Progress(stage, done, total))

    def upload(self, host: Floats) -> cl.array.Array:
        """Give the device a C-ordered float32 array; a CPU reads it in place.

        What is enqueued on :attr:`queue` afterwards finds it there. On a CPU the array has to be
        kept, and left as it is, until the device has done with it.
        """
        if self._shared:
            flags = cl.mem_flags.READ_ONLY | cl.mem_flags.USE_HOST_PTR
            shared = cl.Buffer(self.context, flags, hostbuf=host)
            return cl.array.Array(self.queue, host.shape, host.dtype, data=shared)
        array = self.empty(host.shape)
        self.fill(array, host)
        return array

    def fill(self, array: cl.array.Array, host: Floats) -> None:
        """Copy to an array of a device with memory of its own, as :meth:`upload` does."""
        if host.size:
            cl.enqueue_barrier(self.queue, wait_for=[self._staging.copy(array, host)])

    def empty(self, shape: tuple[int, ...]) -> cl.array.Array:
        """Device array of float32 with undefined contents."""
        return cl.array.empty(self.queue, shape, np.float32, allocator=self.memory)

    def download(self, array: cl.array.Array) -> Floats:
        """Copy of a device array on the host, when all that was enqueued is done."""
        return np.asarray(array.get(queue=self.queue))

    def chunks(self, views: int, bytes_per_view: int) -> list[slice]:
        """Cut views into runs whose radiographs fit the device and the host comfortably."""
        size = max(1, self.budgets.chunk(bytes_per_view) // bytes_per_view)
        # Runs of equal length: no last one of two or three views.
        return equal_runs(views, -(-views // size))

    def slabs(self, grid: VolumeGrid, volumes: int = 1) -> list[slice]:
        """Cut a volume into runs of z planes that each fit one buffer and a third of the budget.

        Parameters
        ----------
        grid : VolumeGrid
            Of the volume.
        volumes : int
            How many of its kind the device has to hold at a time.

        Raises
        ------
        DeviceMemoryError
            If one plane is larger than that.
        """
        nz, ny, nx = grid.shape
        limit = self.budgets.slab // volumes
        planes = limit // (4 * nx * ny)
        if planes < 1:
            raise DeviceMemoryError(
                f"one plane of {ny} x {nx} voxels takes {4 * nx * ny >> 10} KiB, the device allows "
                f"{limit >> 10} KiB: use a coarser grid or raise the memory limit"
            )
        return equal_runs(nz, -(-nz // planes))


def equal_runs(total: int, count: int) -> list[slice]:
    """Cut 0..total into `count` runs whose lengths differ by at most 1."""
    ends = [total * k // count for k in range(count + 1)]
    return [slice(a, b) for a, b in pairwise(ends)]
