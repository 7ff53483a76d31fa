"""Every kernel, in its form for CPUs and its form for GPUs, on small odd shapes.

Few and quick, so that they can be run under a checker such as Oclgrind, see tools/portability.py.
"""

import warnings

import numpy as np
import pyopencl.array as cl_array
import pytest
from operator_cases import CASES, GRID, IMAGES, result

from clra import kernels
from clra.kernels.header import signatures
from clra.ops.registration import phase_correlation
from clra.ops.runtime.devices import choose_device
from clra.ops.runtime.kernel import Step
from clra.ops.runtime.profile import CPU, GPU, forced
from clra.ops.statistics.poisson import RayStatistics
from clra.ops.streaming.multigrid import add_update, cropped
from clra.ops.streaming.slab_projector import volume_from
from clra.ops.streaming.stream import Stream

# Where kernels may have no more than 32 work-items (Rusticl of Mesa 22) reikna gives up.
pytestmark = pytest.mark.filterwarnings("ignore:.*transforms run on the host:UserWarning")


@pytest.mark.parametrize("name", CASES)
def test_forms_for_cpu_and_gpu_agree(name, context, queue, monkeypatch):
    # Phase correlation depends on what images are padded to, which is for the transform to choose.
    monkeypatch.setattr(phase_correlation, "fast_length", lambda context, length: 32)
    case, found = CASES[name], []
    for profile in (CPU, GPU):
        with forced(profile):
            found.append(result(case, case.make(context), queue))
    assert np.isfinite(found[0]).all()
    atol = case.closeness * np.abs(found[0]).max()
    np.testing.assert_allclose(found[1], found[0], rtol=0, atol=atol)


def go_through_a_stream() -> None:
    """What works on volumes in slabs instead of on arrays."""
    stream = Stream(choose_device())
    volume = volume_from(stream, GRID, np.ones(GRID.shape, np.float32))
    add_update(stream, volume, cropped(stream, volume, 0, GRID))
    assert (volume.to_host() == 2).all()
    part = cropped(stream, volume, 1, GRID.slab(1, 4))
    assert (part.to_host() == 2).all()
    images = cl_array.to_device(stream.queue, np.ones(IMAGES, np.float32))
    statistics = RayStatistics(stream.context, np.ones(IMAGES[1:]))
    statistics.deviance(stream.queue, images, images)
    assert statistics.misfit(stream.queue, IMAGES[0]) == 0


def test_no_kernel_is_left_out(context, queue, monkeypatch):
    launched, launch = set(), Step.__call__

    def noted(step, *arguments, **named):
        launched.add(step._kernel.function_name)
        return launch(step, *arguments, **named)

    monkeypatch.setattr(Step, "__call__", noted)
    with warnings.catch_warnings(record=True) as warned:
        for profile in (CPU, GPU):
            with forced(profile):
                for case in CASES.values():
                    result(case, case.make(context), queue)
        go_through_a_stream()
    files = [file for file in kernels.names() if file != "fft.cl" or not warned]
    assert launched >= {one.name for file in files for one in signatures(file)}
