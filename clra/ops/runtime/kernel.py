"""A kernel that is one step of an operator, launched with Python's own numbers."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pyopencl as cl
from pyopencl.array import Array

from clra.ops.runtime import build


class Step:
    """A kernel object with its work-group size.

    Parameters
    ----------
    context : cl.Context
        Where to build it.
    file, function : str
        Kernel file and kernel.
    local : sequence of int
        Work-group wanted; halved until the queue's device allows it.
    defines : mapping, optional
        Preprocessor definitions.
    """

    def __init__(
        self,
        context: cl.Context,
        file: str,
        function: str,
        local: Sequence[int],
        defines: Mapping[str, object] | None = None,
    ) -> None:
        self._builds = build.builds(context)  # held, so that others find it
        self._kernel = self._builds.kernel(file, function, defines)
        self._wanted = tuple(local)
        self._allowed: dict[cl.Device, tuple[int, ...]] = {}

    def __call__(
        self,
        queue: cl.CommandQueue,
        size: Sequence[int],
        *arguments: Any,
        wait_for: Sequence[cl.Event] | None = None,
    ) -> cl.Event:
        """Run over `size`, rounded up to whole work-groups.

        An array is given as buffer and offset, an int as int32, a float as float32.
        """
        values: list[Any] = []
        for argument in arguments:
            if isinstance(argument, Array):
                values.extend(build.buffer_argument(argument))
            elif isinstance(argument, float):
                values.append(np.float32(argument))
            else:
                values.append(np.int32(argument))
        device = queue.device
        local = self._allowed.get(device)
        if local is None:
            local = build.work_group_size(self._kernel, device, self._wanted)
            self._allowed[device] = local
        return self._kernel(
            queue, build.global_size(size, local), local, *values, wait_for=wait_for
        )


def to_device(context: cl.Context, values: Any, dtype: Any = np.float32) -> Array:
    """Copy of host values in an array of the context; takes no queue."""
    host = np.ascontiguousarray(values, dtype)
    flags = cl.mem_flags.READ_WRITE | cl.mem_flags.COPY_HOST_PTR
    return Array(context, host.shape, host.dtype, data=cl.Buffer(context, flags, hostbuf=host))


def group(context: cl.Context, file: str, function: str, wanted: int) -> int:
    """Work-items that share a view: 1 on CPUs, else `wanted` or what the built kernel allows."""
    size = 1 if build.is_cpu(build.device_of(context)) else wanted
    while size > 1:
        kernel = build.builds(context).kernel(file, function, {"GROUP": size})
        if all(build.work_group_size(kernel, d, (size,)) == (size,) for d in context.devices):
            break
        size //= 2
    return size
