"""Device memory for what passes from one kernel of an operator to the next."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pyopencl as cl
from pyopencl.array import Array

Allocator = Callable[[int], Any]


def within(wanted: int, limit: int | None) -> int:
    """Bytes of scratch to use where `wanted` are best and a caller may have set a limit."""
    return wanted if limit is None else min(wanted, limit)


class Scratch:
    """An operator's own memory, which the caller's allocator supplies if there is one.

    It is an allocator itself, for the operators that an operator is made of.

    Parameters
    ----------
    context : cl.Context
        Where the memory lives.
    allocator : callable, optional
        Takes a number of bytes and returns a buffer of the context, as
        ``pyopencl.tools.MemoryPool`` does. A pool gives on what was freed while the device may
        still use it: queues other than the pool's own have to be synchronised by the caller.

    Attributes
    ----------
    bytes : int
        Sum of what was taken.
    """

    def __init__(self, context: cl.Context, allocator: Allocator | None = None) -> None:
        self._context = context
        self._allocator = allocator
        self._blank: list[Array] = []
        self.bytes = 0

    def __call__(self, size: int) -> Any:
        """Take a buffer of `size` bytes."""
        if self._allocator is None:
            memory = cl.Buffer(self._context, cl.mem_flags.READ_WRITE, size)
        else:
            memory = self._allocator(size)
        self.bytes += size
        return memory

    def empty(self, shape: Sequence[int], dtype: Any = np.float32) -> Array:
        """Array with undefined contents."""
        return Array(self._context, tuple(shape), dtype, allocator=self)

    def zeros(self, shape: Sequence[int]) -> Array:
        """Array of float32 that :meth:`cleared` fills with zeros before its first use."""
        array = self.empty(shape)
        self._blank.append(array)
        return array

    def cleared(self, queue: cl.CommandQueue, wait_for: Sequence[cl.Event]) -> Sequence[cl.Event]:
        """Return what has to be done before the first kernel of a call.

        It is `wait_for`; for new arrays of zeros, that they were filled behind it.
        """
        zero = np.zeros(1, np.float32)
        while self._blank:
            memory: Any = self._blank[-1].base_data
            size = self._blank[-1].nbytes
            wait_for = [cl.enqueue_fill(queue, memory, zero, size, wait_for=wait_for)]
            self._blank.pop()
        return wait_for
