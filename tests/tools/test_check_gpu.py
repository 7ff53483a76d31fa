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
    assert len(first.faults()) == 3  # spills, private memory, registers
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


# As nvdisasm writes it: an outer loop, within it a loop of two loads and a multiply-add.
SASS = """\
	.section	.text.first,"ax",@progbits
first:
.text.first:
        /*0000*/                   MOV R1, c[0x0][0x28] ;
.L_x_1:
        /*0010*/                   FADD R2, R2, 1 ;
.L_x_0:
        /*0020*/                   LDG.E R4, [R2.64] ;
        /*0030*/                   LDG.E R5, [R2.64+0x4] ;
        /*0040*/                   FFMA R6, R4, R5, R6 ;
        /*0050*/                   IMAD.WIDE R2, R3, 0x4, R8 ;
        /*0060*/               @P0 BRA `(.L_x_0) ;
        /*0070*/                   MUFU.RCP R2, R2 ;
        /*0080*/               @P1 BRA `(.L_x_1) ;
        /*0090*/                   EXIT ;
"""
GCN = """\
first:                                  ; @first
; %bb.0:
	s_mov_b32 s0, 0
.LBB0_1:                                ; in a loop
	global_load_dwordx2 v[2:3], v1, s[2:3]
	v_pk_fma_f32 v[4:5], v[2:3], v[2:3], v[4:5]
	v_add_u32_e32 v1, 4, v1
	s_cbranch_scc1 .LBB0_1
; %bb.2:
	s_endpgm
	.section	.rodata
"""


@pytest.fixture
def sass(tool):
    return tool("sass")


def test_loops_and_classes_of_nvidia(sass):
    outer, inner = sass.nvidia_kernels(SASS)["first"]
    assert (outer.inner, inner.inner) == (1, 0)
    assert outer.own == {"FP32": 1, "MUFU": 1, "other": 1}
    assert inner.own == {"LOAD": 2, "FP32": 1, "INT64": 1, "other": 1}
    assert inner.always == inner.own


def test_loops_and_classes_of_amd(sass):
    (loop,) = sass.amd_kernels(GCN)["first"]
    assert loop.own == {"LOAD": 1, "FP32": 1, "INT": 1, "SALU": 1}


def test_a_kernel_above_its_limit_is_a_fault(tool):
    limits = tool("gpu_limits")
    rates = {"FP32": 10.0, "LOAD": 4.0, "MUFU": 0.3, "CVT": 0.3}
    assert list(limits._broken("x", rates, {"all": 14.6, "LOAD": 4})) == []
    (fault,) = limits._broken("x", rates, {"MUFU+CVT": 0.5})
    assert fault == "x: 0.60 instructions a unit (MUFU+CVT), at most 0.5"


def test_roofline_by_hand(tool):
    limits = tool("gpu_limits")
    gpu = limits.Gpu("one", 10, 1.0, 64)
    # 13 multiply-adds a unit on 64 lanes: 6.5 clocks for 32 units, more than 20 / 4 to issue.
    rates = {"FP32": 13.0, "INT": 3.0, "LOAD": 4.0}
    assert limits.roofline(rates, gpu) == pytest.approx(32 * 10 * 1e9 / 6.5)
    assert limits.roofline({"LOAD": 4.0}, gpu) == pytest.approx(32 * 10 * 1e9 / 5.2)
