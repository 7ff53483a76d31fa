"""A kernel that is one step of an operator, launched with Python's own numbers."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pyopencl as cl
from pyopencl.array import Array

from clra.ops.runtime.build import builds
from clra.ops.runtime.profile import profile_of


class Step:
    """A kernel object with its work-group size.

    Parameters
    ----------
    context : cl.Context
        Where to build it.
    file, function : str
        Kernel file and kernel.
    local : sequence of int
        Work-group wanted; halved until all devices allow it. For GPUs the kernel is compiled for
        it, as (``GROUP_X``, ``GROUP_Y``, 1).
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
        self._builds = builds(context)  # held, so that others find it
        self._local = tuple(local)
        given: dict[str, object] = dict(defines or {})
        required = not profile_of(context).on_cpu and "GROUP" not in given
        asked: tuple[int, ...] = ()
        while asked != self._local:
            asked = self._local
            if required:
                given |= {"GROUP_X": asked[0], "GROUP_Y": (*asked, 1)[1]}
            self._kernel = self._builds.kernel(file, function, given)
            for device in context.devices:
                self._local = work_group_size(self._kernel, device, self._local)

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
                values.extend(buffer_argument(argument))
            elif isinstance(argument, float):
                values.append(np.float32(argument))
            else:
                values.append(np.int32(argument))
        local = self._local
        return self._kernel(queue, global_size(size, local), local, *values, wait_for=wait_for)


def buffer_argument(array: Array) -> tuple[Any, np.uint64]:
    """Buffer and offset in elements: the two arguments by which every kernel takes an array."""
    return array.base_data, np.uint64(array.offset // array.dtype.itemsize)


def global_size(shape: Sequence[int], local: Sequence[int]) -> tuple[int, ...]:
    """`shape` rounded up to whole work-groups."""
    return tuple(-(-n // m) * m for n, m in zip(shape, local, strict=True))


def work_group_size(
    function: cl.Kernel, device: cl.Device, wanted: Sequence[int]
) -> tuple[int, ...]:
    """`wanted`, halved from the last dimension on until the built kernel allows it."""
    limit = function.get_work_group_info(cl.kernel_work_group_info.WORK_GROUP_SIZE, device)
    sizes = [min(n, m) for n, m in zip(wanted, device.max_work_item_sizes, strict=False)]
    while np.prod(sizes) > limit:
        largest = max(range(len(sizes)), key=lambda axis: (sizes[axis], axis))
        sizes[largest] = max(1, sizes[largest] // 2)
    return tuple(sizes)


def group(
    context: cl.Context,
    file: str,
    function: str,
    wanted: int,
    defines: Mapping[str, object] | None = None,
) -> int:
    """Work-items that share a view: 1 on CPUs, else `wanted` or what the built kernel allows."""
    size = min(wanted, profile_of(context).reduction_group)
    while size > 1:
        kernel = builds(context).kernel(file, function, {**(defines or {}), "GROUP": size})
        if all(work_group_size(kernel, d, (size,)) == (size,) for d in context.devices):
            break
        size //= 2
    return size
