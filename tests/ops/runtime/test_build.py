"""Builds and argument checks."""

import re
import time
import weakref
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pyopencl as cl
import pyopencl.array
import pytest

from clra import kernels
from clra.errors import KernelBuildError
from clra.ops.images.pyramid import Restrict2D
from clra.ops.runtime import build
from clra.ops.runtime.buffers import check_array, check_images
from clra.ops.runtime.kernel import buffer_argument, global_size


def test_build_is_cached_and_a_kernel_is_not(context):
    builds = build.builds(context)
    first, second = (builds.program("transpose.cl") for _ in range(2))
    assert first is second
    assert build.builds(context) is builds
    name = first.all_kernels()[0].function_name
    assert builds.kernel("transpose.cl", name) != builds.kernel("transpose.cl", name)


def test_builds_go_with_the_last_operator(context):
    theirs = cl.Context(context.devices)
    operators = [Restrict2D(theirs), Restrict2D(theirs)]
    builds = weakref.ref(build.builds(theirs))
    operators.pop()
    assert builds() is build.builds(theirs)
    operators.pop()
    assert builds() is None


def test_threads_compile_once(context, monkeypatch):
    compiled = []

    def slowly(context, name, options):
        compiled.append(name)
        time.sleep(0.05)
        return object()

    monkeypatch.setattr(build, "_compile", slowly)
    theirs = cl.Context(context.devices)
    with ThreadPoolExecutor(4) as pool:
        held = list(pool.map(lambda _: build.builds(theirs), range(4)))
        programs = list(pool.map(lambda one: one.program("warp.cl"), held))
    assert compiled == ["warp.cl"]
    assert len(set(map(id, programs))) == 1


def test_the_private_class_of_pyopencl_is_that_of_the_versions_allowed():
    project = Path(__file__).parents[3] / "pyproject.toml"
    below = re.search(r'"pyopencl>=[\d.]+,<(\d+)"', project.read_text())
    assert below is not None
    assert pyopencl.VERSION[0] < int(below[1])
    assert {"build", "all_kernels"} <= set(dir(cl._cl._Program))


def test_a_kernel_that_does_not_compile_raises_with_the_log(context, monkeypatch):
    monkeypatch.setattr(kernels, "source", lambda name: "__kernel void f( { nonsense }")
    with pytest.raises(KernelBuildError, match=r"(?s)broken\.cl.*error"):
        build.builds(context).program("broken.cl")


def test_check_array_names_both_sides(context, queue):
    good = cl.array.zeros(queue, (3, 4), np.float32)
    check_array("x", good, (3, 4), context=context)
    with pytest.raises(ValueError, match=r"x: found shape \(3, 4\), expected \(4, 3\)"):
        check_array("x", good, (4, 3))
    with pytest.raises(ValueError, match="x: found float32, expected complex64"):
        check_array("x", good, (3, 4), np.complex64)
    with pytest.raises(TypeError, match=r"x: found ndarray, expected a pyopencl\.array\.Array"):
        check_array("x", np.zeros((3, 4), np.float32), (3, 4))
    with pytest.raises(ValueError, match="expected C order"):
        check_array("x", good.T, (4, 3))
    with pytest.raises(ValueError, match="is not the operator's"):
        check_array("x", good, (3, 4), context=cl.Context(context.devices))


def test_images_are_counted_if_there_are_any_of_that_shape(context, queue):
    assert check_images("x", cl.array.zeros(queue, (3, 4, 5), np.float32), (4, 5), context) == 3
    for shape in ((3, 5, 4), (4, 5), (1, 3, 4, 5), ()):
        with pytest.raises(
            ValueError, match=r"x: found shape \(.*, expected \(n, 4, 5\) with n at"
        ):
            check_images("x", cl.array.zeros(queue, shape, np.float32), (4, 5), context)
    with pytest.raises(ValueError, match="with n at least 2"):
        one = cl.array.zeros(queue, (1, 4, 5), np.float32)
        check_images("x", one, (4, 5), context, least=2)
    with pytest.raises(TypeError, match="x: found float, expected"):
        check_images("x", 1.0, (4, 5), context)


def test_offset_is_counted_in_elements(queue):
    whole = cl.array.zeros(queue, 10, np.float32)
    buffer, offset = buffer_argument(whole[3:])
    assert buffer == whole.base_data
    assert offset == 3


def test_global_size_rounds_up():
    assert global_size((5, 8, 1), (4, 8, 1)) == (8, 8, 1)
