"""Builds, argument checks; and the cure for PoCL on CPUs it does not know."""

import io
import struct
import time
import weakref
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pyopencl as cl
import pyopencl.array
import pytest

from clra import kernels
from clra.ops.images.pyramid import Restrict2D
from clra.ops.runtime import build, pocl


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


def test_a_kernel_that_does_not_compile_raises_with_the_log(context, monkeypatch):
    monkeypatch.setattr(kernels, "source", lambda name: "__kernel void f( { nonsense }")
    with pytest.raises(build.KernelBuildError, match=r"(?s)broken\.cl.*error"):
        build.builds(context).program("broken.cl")


def test_check_array_names_both_sides(context, queue):
    good = cl.array.zeros(queue, (3, 4), np.float32)
    build.check_array("x", good, (3, 4), context=context)
    with pytest.raises(ValueError, match=r"x: found shape \(3, 4\), expected \(4, 3\)"):
        build.check_array("x", good, (4, 3))
    with pytest.raises(ValueError, match="x: found float32, expected complex64"):
        build.check_array("x", good, (3, 4), np.complex64)
    with pytest.raises(TypeError, match=r"x: found ndarray, expected a pyopencl\.array\.Array"):
        build.check_array("x", np.zeros((3, 4), np.float32), (3, 4))
    with pytest.raises(ValueError, match="expected C order"):
        build.check_array("x", good.T, (4, 3))
    with pytest.raises(ValueError, match="is not the operator's"):
        build.check_array("x", good, (3, 4), context=cl.Context(context.devices))


def test_images_are_counted_if_there_are_any_of_that_shape(context, queue):
    assert (
        build.check_images("x", cl.array.zeros(queue, (3, 4, 5), np.float32), (4, 5), context) == 3
    )
    for shape in ((3, 5, 4), (4, 5), (1, 3, 4, 5), ()):
        with pytest.raises(
            ValueError, match=r"x: found shape \(.*, expected \(n, 4, 5\) with n at"
        ):
            build.check_images("x", cl.array.zeros(queue, shape, np.float32), (4, 5), context)
    with pytest.raises(ValueError, match="with n at least 2"):
        one = cl.array.zeros(queue, (1, 4, 5), np.float32)
        build.check_images("x", one, (4, 5), context, least=2)
    with pytest.raises(TypeError, match="x: found float, expected"):
        build.check_images("x", 1.0, (4, 5), context)


def test_offset_is_counted_in_elements(queue):
    whole = cl.array.zeros(queue, 10, np.float32)
    buffer, offset = build.buffer_argument(whole[3:])
    assert buffer == whole.base_data
    assert offset == 3


def test_global_size_rounds_up():
    assert build.global_size((5, 8, 1), (4, 8, 1)) == (8, 8, 1)


class _Memory(io.BytesIO):
    """Stands for the process's memory: a device record at 64, the name's text at 512."""

    def __init__(self, text: bytes) -> None:
        record = bytearray(4096)
        struct.pack_into("PP", record, 64 + 16, 0xDEAD0000, 512)
        record[512 : 512 + len(text)] = text
        super().__init__(bytes(record))


def test_mending_points_the_record_at_a_known_cpu():
    import ctypes

    memory = _Memory(b"generic\0")
    assert pocl._replace(memory, 64, b"haswell")
    (address,) = struct.unpack_from("P", memory.getvalue(), 64 + 24)
    assert ctypes.string_at(address) == b"haswell"


def test_mending_leaves_a_record_without_the_name_alone():
    memory = _Memory(b"generic-ish\0")
    before = memory.getvalue()
    assert not pocl._replace(memory, 64, b"haswell")
    assert memory.getvalue() == before


@pytest.mark.parametrize(
    ("flags", "cpu"),
    [
        ("sse2", b"x86-64"),
        ("avx2 fma bmi2 movbe f16c", b"haswell"),
        ("avx2 fma bmi2 movbe f16c avx512f avx512bw avx512dq avx512vl", b"skylake-avx512"),
        ("avx2 fma bmi2 movbe f16c avx512f", b"haswell"),
    ],
)
def test_the_widest_cpu_that_this_one_covers_is_taken(flags, cpu):
    assert pocl._closest_cpu(set(flags.split())) == cpu
