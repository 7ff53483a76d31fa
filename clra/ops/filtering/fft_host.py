"""Real Fourier transforms on the host, for CPU devices: see :mod:`clra.ops.filtering.fft`."""

import math
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import pyopencl as cl
from pyopencl.array import Array

# Bytes of real lines that one thread transforms at a time: input, spectrum and result stay in the
# cache. Twice or half of it is 5 to 20 % slower (lines of 2048, two cores, 2 MB of cache).
_BLOCK_BYTES = 2 << 20

_Block = np.ndarray[Any, np.dtype[Any]]
_READ = cl.map_flags.READ


class HostFFT:
    """pocketfft on mapped buffers, in blocks, on as many threads as the device has."""

    def __init__(
        self, context: cl.Context, shape: tuple[int, int, int], axes: tuple[int, ...]
    ) -> None:
        self._axes = axes
        self._lengths = shape[axes[0] :]
        # Fewer than the machine has where several processes share it.
        self._cores = max(1, context.devices[0].max_compute_units)
        self._pool = ThreadPoolExecutor(self._cores)

    def forward(
        self, queue: cl.CommandQueue, spectrum: Array, image: Array, wait_for: list[cl.Event]
    ) -> cl.Event:
        """As :meth:`clra.ops.filtering.fft.RealFFT.forward`, of arrays that were checked."""
        from scipy import fft

        def transform(out: _Block, lines: _Block, workers: int) -> None:
            out[...] = fft.rfftn(lines, axes=self._axes, workers=workers)

        return self._run(queue, transform, spectrum, image, wait_for)

    def inverse(
        self, queue: cl.CommandQueue, image: Array, spectrum: Array, wait_for: list[cl.Event]
    ) -> cl.Event:
        """As :meth:`clra.ops.filtering.fft.RealFFT.inverse`, of arrays that were checked."""
        from scipy import fft

        def transform(out: _Block, lines: _Block, workers: int) -> None:
            out[...] = fft.irfftn(lines, self._lengths, axes=self._axes, workers=workers)

        return self._run(queue, transform, image, spectrum, wait_for)

    def apply(
        self,
        queue: cl.CommandQueue,
        out: Array,
        image: Array,
        multiplier: Array,
        wait_for: list[cl.Event],
    ) -> cl.Event:
        """As :meth:`clra.ops.filtering.fft.RealFFT.apply`, of arrays that were checked."""
        from scipy import fft

        memory, factors = _map(queue, multiplier, _READ, wait_for)

        def transform(out: _Block, lines: _Block, workers: int) -> None:
            spectrum = fft.rfftn(lines, axes=self._axes, workers=workers)
            spectrum *= factors
            out[...] = fft.irfftn(
                spectrum, self._lengths, axes=self._axes, overwrite_x=True, workers=workers
            )

        done = self._run(queue, transform, out, image, wait_for)
        return memory.release(queue, [done])

    def _run(
        self,
        queue: cl.CommandQueue,
        transform: Callable[[_Block, _Block, int], None],
        out: Array,
        source: Array,
        wait_for: list[cl.Event],
    ) -> cl.Event:
        if (out.base_data, out.offset) == (source.base_data, source.offset):
            # Overlapping maps, one of them for writing, are undefined.
            memory, result = _map(queue, out, _READ | cl.map_flags.WRITE, wait_for)
            memories, values = [memory], result
        else:
            source_memory, values = _map(queue, source, _READ, wait_for)
            out_memory, result = _map(queue, out, cl.map_flags.WRITE_INVALIDATE_REGION, wait_for)
            memories = [source_memory, out_memory]
        try:
            self._in_blocks(transform, self._lines(result), self._lines(values))
        finally:
            released = [memory.release(queue) for memory in memories]
        return cl.enqueue_marker(queue, released)

    def _lines(self, mapped: _Block) -> _Block:
        """Rows count as items of their own where they are not transformed."""
        return mapped.reshape(-1, 1, mapped.shape[2]) if self._axes == (2,) else mapped

    def _in_blocks(
        self, transform: Callable[[_Block, _Block, int], None], out: _Block, source: _Block
    ) -> None:
        n = len(out)
        item_bytes = 4 * math.prod(self._lengths)
        step = min(max(1, _BLOCK_BYTES // item_bytes), -(-n // self._cores))
        starts = range(0, n, step)
        workers = max(1, self._cores // len(starts))

        def block(start: int) -> None:
            part = slice(start, start + step)
            transform(out[part], source[part], workers)

        # list() raises what a thread raised.
        list(self._pool.map(block, starts))


def _map(
    queue: cl.CommandQueue, array: Array, flags: int, wait_for: list[cl.Event]
) -> tuple[cl.MemoryMap, _Block]:
    """Map an array's part of its buffer; blocks until what it waits for is done."""
    mapping: Any = cl.enqueue_map_buffer
    values, _ = mapping(
        queue, array.base_data, flags, array.offset, array.shape, array.dtype, wait_for=wait_for
    )
    return values.base, values
