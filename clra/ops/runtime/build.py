"""What operators ask of OpenCL: built kernels, work-group sizes, and arguments that fit."""

import threading
import weakref
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pyopencl as cl
import pyopencl.array

from clra import kernels
from clra.errors import InputError, KernelBuildError
from clra.ops.runtime import pocl

BUILD_OPTIONS = ("-cl-std=CL1.2", "-cl-mad-enable", "-cl-denorms-are-zero")


def device_of(owner: cl.Context | cl.CommandQueue) -> cl.Device:
    """Device of a queue, or the only (else first) device of a context."""
    return owner.device if isinstance(owner, cl.CommandQueue) else owner.devices[0]


def is_cpu(device: cl.Device) -> bool:
    """Whether the device is a CPU, whose best kernel form differs from a GPU's."""
    return bool(device.type & cl.device_type.CPU)


class Builds:
    """Compiled kernel files of one context, each compiled once a set of definitions; thread-safe.

    Parameters
    ----------
    context : cl.Context
        Where to build, for all its devices.
    """

    def __init__(self, context: cl.Context) -> None:
        self._context = context
        self._programs: dict[tuple[str, tuple[str, ...]], cl.Program] = {}
        self._lock = threading.Lock()

    def program(self, name: str, defines: Mapping[str, object] | None = None) -> cl.Program:
        """Compile one kernel file.

        Parameters
        ----------
        name : str
            File in ``kernels/``.
        defines : mapping, optional
            Preprocessor definitions.

        Returns
        -------
        cl.Program

        Raises
        ------
        KernelBuildError
            With the compiler's log.
        """
        options = (*BUILD_OPTIONS, *(f"-D{key}={value}" for key, value in (defines or {}).items()))
        with self._lock:
            if (name, options) not in self._programs:
                self._programs[name, options] = _compile(self._context, name, options)
            return self._programs[name, options]

    def kernel(
        self, name: str, function: str, defines: Mapping[str, object] | None = None
    ) -> cl.Kernel:
        """Return a new kernel object: its arguments are its owner's alone."""
        return cl.Kernel(self.program(name, defines), function)


_builds: weakref.WeakValueDictionary[int, Builds] = weakref.WeakValueDictionary()
_builds_lock = threading.Lock()


def builds(context: cl.Context) -> Builds:
    """Compiled kernels of a context, the same object for all who ask while one of them holds it.

    Operators hold it: as long as one of a context lives, nothing is compiled twice there, and after
    the last one nothing is left that would keep the context.
    """
    with _builds_lock:
        # It holds its context, whose address so is not given to another one.
        found = _builds.get(context.int_ptr)
        if found is None:
            found = _builds[context.int_ptr] = Builds(context)
        return found


def _compile(context: cl.Context, name: str, options: Sequence[str]) -> cl.Program:
    # pyopencl's public build() adds an include path, which breaks several drivers where it holds a
    # blank, and a binary cache that outlives driver updates; drivers cache by themselves.
    program = cl._cl._Program(context, kernels.source(name))
    try:
        program.build(" ".join((*options, *pocl.build_options(context.devices))).encode())
    except cl.Error as error:
        raise KernelBuildError(f"kernel {name} does not build: {error}") from None
    built = cl.Program(program)
    # pyopencl would look for a kernel of this name, an error that API checkers complain of.
    built._source = kernels.source(name)
    return built


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
    if not isinstance(array, cl.array.Array):
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


def buffer_argument(array: cl.array.Array) -> tuple[Any, np.uint64]:
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
