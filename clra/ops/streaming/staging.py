"""Page-locked host memory through which arrays go to a device without blocking."""

from typing import Any

import numpy as np
import pyopencl as cl
from numpy.typing import NDArray
from pyopencl.array import Array

# One is filled, one is on its way, one waits for its turn.
_SLOTS = 3


class Staging:
    """A ring of page-locked buffers.

    A copy from memory that the system may move blocks the host; from these it does not. The event
    of a copy is kept until its buffer's next turn: pyopencl waits for one that is let go.

    Parameters
    ----------
    queue : cl.CommandQueue
        In order; what it copies runs beside other queues.
    size : int
        Bytes of a buffer.
    """

    def __init__(self, queue: cl.CommandQueue, size: int) -> None:
        self._queue, self._size = queue, max(4, size - size % 4)
        self._memory: list[NDArray[np.float32]] = []
        self._events: list[cl.Event | None] = [None] * _SLOTS
        self._turn = 0

    def copy(self, target: Array, host: NDArray[np.float32]) -> cl.Event:
        """Copy an array; it may be changed as soon as this returns.

        Parameters
        ----------
        target : Array
            float32 of the device.
        host : ndarray
            float32 of the same size, in C order.

        Returns
        -------
        cl.Event
            When all is there.
        """
        values = host.reshape(-1)
        buffer: Any = target.base_data
        step = self._size // 4
        for start in range(0, values.size, step):
            part = values[start : start + step]
            slot = self._take()[: part.size]
            np.copyto(slot, part)
            event = cl.enqueue_copy(
                self._queue,
                buffer,
                slot,
                dst_offset=target.offset + 4 * start,
                is_blocking=False,
            )
            self._queue.flush()
            self._events[self._turn] = event
        return event

    def _take(self) -> NDArray[np.float32]:
        """Return the next buffer when it is free."""
        self._turn = (self._turn + 1) % _SLOTS
        if len(self._memory) < _SLOTS:
            flags = cl.mem_flags.READ_WRITE | cl.mem_flags.ALLOC_HOST_PTR
            pinned = cl.Buffer(self._queue.context, flags, self._size)
            access: Any = cl.map_flags.READ | cl.map_flags.WRITE
            shape, floats = (self._size // 4,), np.dtype(np.float32)
            mapped: Any = cl.enqueue_map_buffer(self._queue, pinned, access, 0, shape, floats)
            memory = mapped[0]
            self._memory.append(memory)
            self._turn = len(self._memory) - 1
        last = self._events[self._turn]
        if last is not None:
            last.wait()
        return self._memory[self._turn]
