import pytest

from clra import kernels

PTXAS = """\
ptxas info    : 0 bytes gmem
ptxas info    : Compiling entry function 'first' for 'sm_80'
ptxas info    : Function properties for first
    64 bytes stack frame, 8 bytes spill stores, 12 bytes spill loads
ptxas info    : Used 80 registers, used 1 barriers, 1024 bytes smem, 432 bytes cmem[0]
ptxas info    : Compiling entry function 'second' for 'sm_80'
ptxas info    : Function properties for second
    0 bytes stack frame, 0 bytes spill stores, 0 bytes spill loads
ptxas info    : Used 19 registers, used 0 barriers, 408 bytes cmem[0]
"""


@pytest.fixture
def check_gpu(tool):
    return tool("check_gpu")


@pytest.fixture
def gpu_usage(tool):
    return tool("gpu_usage")


def test_every_kernel_file_has_its_forms(check_gpu):
    assert set(check_gpu.GPU_FORMS) | check_gpu.CPU_ONLY == set(kernels.names())
    assert not set(check_gpu.GPU_FORMS) & check_gpu.CPU_ONLY


def test_ptxas_report(gpu_usage):
    first, second = gpu_usage.read_ptxas(PTXAS, "warp.cl", "sm_80", 164 << 10)
    assert (first.kernel, first.registers, first.spills) == ("warp.cl first", 80, 20)
    assert (first.private, first.local) == (64, 1024)
    assert (second.registers, second.spills, second.private, second.local) == (19, 0, 0, 0)
    assert len(first.faults()) == 2
    assert not second.faults()


# From NVIDIA's occupancy calculator's rules, by hand.
@pytest.mark.parametrize(
    ("registers", "local", "work_items", "expected"),
    [
        (32, 0, 256, 1.0),
        (33, 0, 256, 6 / 8),  # 40 registers a work-item: 51 warps, 6 groups of 8
        (64, 0, 256, 0.5),
        (16, 0, 32, 0.5),  # at most 32 groups
        (16, 0, 1, 0.5),
        (16, (81 << 10), 256, 2 / 8),  # 164 KiB hold two
    ],
)
def test_occupancy(gpu_usage, registers, local, work_items, expected):
    found = gpu_usage.occupancy(registers, local, work_items, 164 << 10)
    assert found == pytest.approx(expected)
