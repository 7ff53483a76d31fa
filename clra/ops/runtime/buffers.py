"""Arrays of a device: made, checked, and held between the kernels of an operator."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pyopencl as cl
from pyopencl.array import Array

from clra.errors import InputError

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


def to_device(context: cl.Context, values: Any, dtype: Any = np.float32) -> Array:
    """Copy of host values in an array of the context; takes no queue."""
    host = np.ascontiguousarray(values, dtype)
    flags = cl.mem_flags.READ_WRITE | cl.mem_flags.COPY_HOST_PTR
    return Array(context, host.shape, host.dtype, data=cl.Buffer(context, flags, hostbuf=host))


def check_array(
    name: str,
    array: Any,
    shape: tuple[int, ...],
    dtype: Any = np.float32,
    context: cl.Context | None = None,
) -> None:
    """Refuse what an operator cannot work on.

    Parameters
    ----------
    name : str
        The argument's name, for the message.
    array : cl.array.Array
        To be checked; an offset into its buffer is fine.
    shape : tuple of int
        Expected shape.
    dtype : dtype-like
        Expected type.
    context : cl.Context, optional
        Context that the array has to belong to.

    Raises
    ------
    TypeError
        If it is no device array.
    InputError
        If type, shape, memory order or context differ.
    """
    if not isinstance(array, Array):
        raise TypeError(f"{name}: found {type(array).__name__}, expected a pyopencl.array.Array")
    if array.dtype != np.dtype(dtype):
        raise InputError(f"{name}: found {array.dtype}, expected {np.dtype(dtype)}")
    if array.shape != tuple(shape):
        raise InputError(f"{name}: found shape {array.shape}, expected {tuple(shape)}")
    if not array.flags.c_contiguous:
        raise InputError(f"{name}: found strides {array.strides}, expected C order")
    if context is not None and array.context != context:
        raise InputError(f"{name}: its context {array.context} is not the operator's {context}")


def check_images(
    name: str, array: Any, shape: tuple[int, ...], context: cl.Context, least: int = 1
) -> int:
    """Return how many images there are in an array; refuse what holds none of that shape.

    Parameters
    ----------
    name : str
        The argument's name, for the message.
    array : cl.array.Array
        To be checked: float32 (n, rows, columns).
    shape : tuple of int
        Expected rows and columns.
    context : cl.Context
        Context that the array has to belong to.
    least : int
        Least number of images.

    Raises
    ------
    TypeError, InputError
        As :func:`check_array` does, and for fewer images.
    """
    check_array(name, array, getattr(array, "shape", ()), context=context)
    if array.shape[1:] != tuple(shape) or array.ndim == 0 or len(array) < least:
        expected = ", ".join(["n", *map(str, shape)])
        raise InputError(
            f"{name}: found shape {array.shape}, expected ({expected}) with n at least {least}"
        )
    return len(array)


def check_queue(queue: cl.CommandQueue, context: cl.Context) -> None:
    """Refuse a queue of another context than an operator's, with a ValueError."""
    if queue.context != context:
        raise InputError(f"queue: its context {queue.context} is not the operator's {context}")
