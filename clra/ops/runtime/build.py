"""Compiled kernel files of a context."""

import threading
import weakref
from collections.abc import Mapping, Sequence

import pyopencl as cl

from clra import kernels
from clra.errors import KernelBuildError
from clra.ops.runtime import pocl

BUILD_OPTIONS = ("-cl-std=CL1.2", "-cl-mad-enable", "-cl-denorms-are-zero")


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
    # blank, and a binary cache that outlives driver updates; drivers cache by themselves. The class
    # is private: pyproject.toml bounds the version, and a test builds with it.
    program = cl._cl._Program(context, kernels.source(name))
    try:
        program.build(" ".join((*options, *pocl.build_options(context.devices))).encode())
    except cl.Error as error:
        raise KernelBuildError(f"kernel {name} does not build: {error}") from None
    built = cl.Program(program)
    # pyopencl would look for a kernel of this name, an error that API checkers complain of.
    built._source = kernels.source(name)
    return built
