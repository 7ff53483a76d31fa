"""Real Fourier transforms on GPUs: see :mod:`clra.ops.filtering.fft`."""

import math
from functools import partial
from typing import Any

import numpy as np
import pyopencl as cl
from pyopencl.array import Array

from clra.ops.runtime.buffers import Allocator, Scratch
from clra.ops.runtime.kernel import Step
from clra.ops.runtime.profile import device_of


class NoPlanError(RuntimeError):
    """reikna finds no work-groups for its kernels that the device allows."""


class _Chain:
    """A reikna transform of one device, enqueued like any other kernel.

    reikna 0.9 binds a transform to a queue and takes no events. Here each of its kernels goes to
    the queue of the call, behind the one before.
    """

    def __init__(self, transform: Any) -> None:
        self._transform = transform
        for call in transform._kernel_calls:
            kernel = call._kernel._kernel  # reikna's, of which `_kernel` is pyopencl's
            kernel._kernel = partial(self._enqueue, kernel._kernel)

    def __call__(
        self, queue: cl.CommandQueue, work: Array, inverse: bool, wait_for: list[cl.Event]
    ) -> cl.Event:
        """Transform in place."""
        self._queue, self._events = queue, wait_for
        self._transform(work, work, inverse=inverse)
        (event,) = self._events
        del self._queue, self._events
        return event

    def _enqueue(
        self, kernel: cl.Kernel, _: Any, size: Any, local: Any, *arguments: Any
    ) -> cl.Event:
        event = kernel(self._queue, size, local, *arguments, wait_for=self._events)
        self._events = [event]
        return event


class DeviceFFT:
    """reikna's complex transforms of half the length, planned for each device of the context."""

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
        self._spectrum_shape = (n, self._rows, self._columns // 2 + 1)
        work = (n, self._rows, self._width)
        planned: tuple[int, ...] = work
        if self._width == 1 and self._two_axes:
            # reikna 0.9 fails on a last axis of one element behind one that is no power of two.
            planned, axes = planned[:2], (1,)
        transform = FFT(Type(np.complex64, planned), axes=axes)

        def plan(device: cl.Device) -> _Chain:
            # A queue to copy reikna's constants by, which is not used any more then.
            thread = ocl_api().Thread(cl.CommandQueue(context, device))
            try:
                compiled = transform.compile(thread)
            except (ValueError, ZeroDivisionError) as error:  # as it meets small work-groups
                raise NoPlanError(f"{device.name.strip()}: reikna: {error}") from None
            thread.synchronize()
            return _Chain(compiled)

        self._plan = plan
        first = device_of(context)
        self._plans = {first: plan(first)}
        self._work = self._memory.empty(work, np.complex64)
        self.scratch_bytes = self._work.nbytes + 8 * math.prod(self._spectrum_shape)
        self._spectrum: Array | None = None
        self._last: list[cl.Event] = []

    def forward(
        self, queue: cl.CommandQueue, spectrum: Array, image: Array, wait_for: list[cl.Event]
    ) -> cl.Event:
        """As :meth:`clra.ops.filtering.fft.RealFFT.forward`, of arrays that were checked."""
        self._last = [self._forward(queue, spectrum, image, [*wait_for, *self._last])]
        return self._last[0]

    def inverse(
        self, queue: cl.CommandQueue, image: Array, spectrum: Array, wait_for: list[cl.Event]
    ) -> cl.Event:
        """As :meth:`clra.ops.filtering.fft.RealFFT.inverse`, of arrays that were checked."""
        self._last = [self._inverse(queue, image, spectrum, [*wait_for, *self._last])]
        return self._last[0]

    def apply(
        self,
        queue: cl.CommandQueue,
        out: Array,
        image: Array,
        multiplier: Array,
        wait_for: list[cl.Event],
    ) -> cl.Event:
        """As :meth:`clra.ops.filtering.fft.RealFFT.apply`, of arrays that were checked."""
        if self._spectrum is None:
            self._spectrum = self._memory.empty(self._spectrum_shape, np.complex64)
        spectrum = self._spectrum[: len(image)]
        event = self._forward(queue, spectrum, image, [*wait_for, *self._last])
        sizes = self._sizes(len(image))
        parts = multiplier.dtype.itemsize // np.dtype(np.float32).itemsize
        event = self._multiply(
            queue,
            spectrum.shape[::-1],
            *(spectrum, multiplier, parts, *sizes, self._two_axes),
            wait_for=[event],
        )
        self._last = [self._inverse(queue, out, spectrum, [event])]
        return self._last[0]

    def _forward(
        self, queue: cl.CommandQueue, spectrum: Array, image: Array, wait_for: list[cl.Event]
    ) -> cl.Event:
        sizes = self._sizes(len(image))
        size = (self._width, *sizes[1:])
        event = self._real_to_work(queue, size, self._work, image, *sizes, wait_for=wait_for)
        event = self._planned(queue)(queue, self._work, False, [event])
        arguments = (spectrum, self._work, *sizes, self._two_axes)
        return self._work_to_spectrum(queue, spectrum.shape[::-1], *arguments, wait_for=[event])

    def _inverse(
        self, queue: cl.CommandQueue, image: Array, spectrum: Array, wait_for: list[cl.Event]
    ) -> cl.Event:
        sizes = self._sizes(len(image))
        size = (self._width, *sizes[1:])
        arguments = (self._work, spectrum, *sizes, self._two_axes)
        event = self._spectrum_to_work(queue, size, *arguments, wait_for=wait_for)
        event = self._planned(queue)(queue, self._work, True, [event])
        return self._work_to_real(queue, size, image, self._work, *sizes, wait_for=[event])

    def _planned(self, queue: cl.CommandQueue) -> _Chain:
        """Transform for the queue's device."""
        if queue.device not in self._plans:
            self._plans[queue.device] = self._plan(queue.device)
        return self._plans[queue.device]

    def _sizes(self, items: int) -> tuple[int, int, int]:
        """Sizes in the order in which the kernels and their ranges take them."""
        return self._columns, self._rows, items
