"""Real Fourier transforms on GPUs: see :mod:`clra.ops.fft`."""

import math
from typing import Any

import numpy as np
import pyopencl as cl
from pyopencl.array import Array

from clra.ops import opencl
from clra.ops.scratch import Allocator, Scratch
from clra.ops.steps import Step


class DeviceFFT:
    """reikna's complex transforms of half the length.

    reikna binds a transform to one queue and takes no events, so there is a queue of its own for
    each device, in order; markers tie it to the caller's.
    """

    def __init__(
        self,
        context: cl.Context,
        shape: tuple[int, int, int],
        axes: tuple[int, ...],
        allocator: Allocator | None,
    ) -> None:
        from reikna.cluda import ocl_api
        from reikna.core import Type
        from reikna.fft import FFT

        def step(name: str) -> Step:
            return Step(context, "fft.cl", name, (64, 1, 1))

        self._memory = Scratch(context, allocator)
        self._real_to_work = step("real_to_work")
        self._work_to_real = step("work_to_real")
        self._work_to_spectrum = step("work_to_spectrum")
        self._spectrum_to_work = step("spectrum_to_work")
        self._multiply = step("multiply_spectrum")
        n, self._rows, self._columns = shape
        self._width = self._columns if self._columns % 2 else self._columns // 2
        self._two_axes = len(axes) == 2
        self._work = self._memory.empty((n, self._rows, self._width), np.complex64)
        self._spectrum_shape = (n, self._rows, self._columns // 2 + 1)
        self.scratch_bytes = self._work.nbytes + 8 * math.prod(self._spectrum_shape)
        planned: tuple[int, ...] = self._work.shape
        if self._width == 1 and self._two_axes:
            # reikna 0.9 fails on a last axis of one element behind one that is no power of two.
            planned, axes = planned[:2], (1,)
        transform = FFT(Type(np.complex64, planned), axes=axes)

        def plan(device: cl.Device) -> tuple[cl.CommandQueue, Any]:
            queue = cl.CommandQueue(context, device)
            return queue, transform.compile(ocl_api().Thread(queue))

        self._plan = plan
        first = opencl.device_of(context)
        self._plans = {first: plan(first)}
        self._queue, self._transform = self._plans[first]
        self._spectrum: Array | None = None

    def forward(
        self, queue: cl.CommandQueue, spectrum: Array, image: Array, wait_for: list[cl.Event]
    ) -> cl.Event:
        """As :meth:`clra.ops.fft.RealFFT.forward`, of arrays that were checked."""
        self._wait(queue, wait_for)
        return self._signal(queue, self._forward(spectrum, image))

    def inverse(
        self, queue: cl.CommandQueue, image: Array, spectrum: Array, wait_for: list[cl.Event]
    ) -> cl.Event:
        """As :meth:`clra.ops.fft.RealFFT.inverse`, of arrays that were checked."""
        self._wait(queue, wait_for)
        return self._signal(queue, self._inverse(image, spectrum))

    def apply(
        self,
        queue: cl.CommandQueue,
        out: Array,
        image: Array,
        multiplier: Array,
        wait_for: list[cl.Event],
    ) -> cl.Event:
        """As :meth:`clra.ops.fft.RealFFT.apply`, of arrays that were checked."""
        if self._spectrum is None:
            self._spectrum = self._memory.empty(self._spectrum_shape, np.complex64)
        spectrum = self._spectrum[: len(image)]
        self._wait(queue, wait_for)
        self._forward(spectrum, image)
        sizes = self._sizes(len(image))
        parts = multiplier.dtype.itemsize // np.dtype(np.float32).itemsize
        self._multiply(
            self._queue, spectrum.shape[::-1], spectrum, multiplier, parts, *sizes, self._two_axes
        )
        return self._signal(queue, self._inverse(out, spectrum))

    def _forward(self, spectrum: Array, image: Array) -> cl.Event:
        sizes = self._sizes(len(image))
        size = (self._width, *sizes[1:])
        self._real_to_work(self._queue, size, self._work, image, *sizes)
        self._transform(self._work, self._work)
        return self._work_to_spectrum(
            self._queue, spectrum.shape[::-1], spectrum, self._work, *sizes, self._two_axes
        )

    def _inverse(self, image: Array, spectrum: Array) -> cl.Event:
        sizes = self._sizes(len(image))
        size = (self._width, *sizes[1:])
        self._spectrum_to_work(self._queue, size, self._work, spectrum, *sizes, self._two_axes)
        self._transform(self._work, self._work, inverse=True)
        return self._work_to_real(self._queue, size, image, self._work, *sizes)

    def _sizes(self, items: int) -> tuple[int, int, int]:
        """Sizes in the order in which the kernels and their ranges take them."""
        return self._columns, self._rows, items

    def _wait(self, queue: cl.CommandQueue, wait_for: list[cl.Event]) -> None:
        """Let the own queue wait for the events and for what an in-order queue holds already."""
        events = list(wait_for)
        if queue.device != self._queue.device:
            events.append(cl.enqueue_marker(self._queue))  # which may still use the work array
            self._queue.flush()
            if queue.device not in self._plans:
                self._plans[queue.device] = self._plan(queue.device)
            self._queue, self._transform = self._plans[queue.device]
        if not queue.properties & cl.command_queue_properties.OUT_OF_ORDER_EXEC_MODE_ENABLE:
            events.append(cl.enqueue_marker(queue))
        queue.flush()
        if events:
            cl.enqueue_barrier(self._queue, events)

    def _signal(self, queue: cl.CommandQueue, event: cl.Event) -> cl.Event:
        self._queue.flush()
        return cl.enqueue_marker(queue, [event])
