"""PoCL's compiler is paired with its built-ins: on forged records and on the real one."""

import ctypes
import mmap
import re
import types
from pathlib import Path

import pytest

from clra.errors import ClraWarning
from clra.ops.runtime import devices, pocl

# What /proc/cpuinfo says of a CPU for which PoCL chooses each variant, without what plays no part.
SSE = "sse sse2 pni cx16"
AVX = f"{SSE} ssse3 sse4_1 sse4_2 popcnt avx"
HASWELL = f"{AVX} f16c fma abm bmi1 bmi2 avx2 movbe"
CPUS = {
    "x86-64": SSE,
    "core2": f"{SSE} ssse3",
    "penryn": f"{SSE} ssse3 sse4_1",
    "sandybridge": AVX,
    "ivybridge": f"{AVX} f16c",
    "bdver1": f"{AVX} xop fma4 f16c abm",
    "haswell": HASWELL,
    "skylake-avx512": f"{HASWELL} avx512f avx512bw avx512dq avx512vl",
}
TRIPLE = b"x86_64-unknown-linux-gnu"


def version(cpu: str) -> str:
    """What the device says of itself."""
    return f"OpenCL 3.0 PoCL HSTR: pthread-{TRIPLE.decode()}-{cpu}"


class Record:
    """Memory like PoCL's device record: other pointers and numbers, the triple, the CPU's name."""

    def __init__(self, *texts: bytes, at: int = 632) -> None:
        self.texts = [ctypes.create_string_buffer(text) for text in (b"AuthenticAMD", *texts)]
        self.words = (ctypes.c_size_t * 256)(*range(256))
        self.first = at // 8 - 1
        for place, text in enumerate(self.texts, self.first):
            self.words[place] = ctypes.addressof(text)

    @property
    def address(self) -> int:
        return ctypes.addressof(self.words)

    def text(self, place: int) -> bytes:
        return ctypes.string_at(self.words[self.first + 1 + place])


@pytest.mark.parametrize("cpu", CPUS)
def test_a_record_gets_the_cpu_of_the_variant(cpu):
    record = Record(TRIPLE, b"znver3", b"other")
    before = list(record.words)
    found = pocl.cpu_of_variant(frozenset(CPUS[cpu].split()))
    assert found == cpu
    assert pocl.pair_record(record.address, version("znver3"), found)
    assert [record.text(place) for place in range(3)] == [TRIPLE, cpu.encode(), b"other"]
    changed = [place for place in range(256) if record.words[place] != before[place]]
    assert changed == [record.first + 2]


def test_variants_are_those_of_the_wheel():
    wheel = pytest.importorskip("pocl_binary_distribution")
    files = Path(wheel.__file__).parent.rglob("kernel-x86_64-unknown-linux-gnu-*.bc")
    shipped = {file.stem.rpartition("-")[2] for file in files}
    assert shipped == {variant for variant, _, _ in pocl.VARIANTS}
    assert {cpu for _, cpu, _ in pocl.VARIANTS} == set(CPUS)


def test_a_cpu_that_is_no_x86_has_no_variant():
    assert pocl.cpu_of_variant(frozenset(["neon", "asimd"])) is None


@pytest.mark.parametrize("at", [16, 632, 1000])
def test_a_generic_name_is_replaced_wherever_the_record_has_it(at):
    record = Record(TRIPLE, b"generic", at=at)
    assert pocl.pair_record(record.address, version("generic"), "haswell")
    assert record.text(1) == b"haswell"


@pytest.mark.parametrize(
    "texts",
    [
        (b"aarch64-unknown-linux-gnu", b"cortex-a72"),
        (b"x86_64-apple-darwin20.6.0", b"haswell"),
        (TRIPLE, b"AMD EPYC"),
        (TRIPLE, b""),
        (TRIPLE,),
        (b"znver3", TRIPLE),
        (TRIPLE, b"avx2", b"znver3"),  # Debian's 3.1 has the variant between the two
        (TRIPLE, b"znver4"),
        (TRIPLE, b"a" * 80),
    ],
)
def test_a_record_that_is_not_as_expected_is_left_alone(texts):
    record = Record(*texts)
    before = bytes(record.words)
    assert not pocl.pair_record(record.address, version("znver3"), "haswell")
    assert bytes(record.words) == before


def test_a_record_that_is_right_is_left_alone():
    record = Record(TRIPLE, b"haswell")
    before = bytes(record.words)
    assert pocl.pair_record(record.address, version("znver3"), "haswell")
    assert bytes(record.words) == before


def test_a_name_that_was_given_can_be_replaced():
    record = Record(TRIPLE, b"znver3")
    for name in ("skylake-avx512", "haswell", "skylake-avx512"):
        assert pocl.pair_record(record.address, version("znver3"), name)
        assert record.text(1) == name.encode()


def test_memory_that_is_not_there_or_not_writable_is_not_touched():
    assert not pocl.pair_record(0, "", "haswell")
    assert not pocl.pair_record(2**47 - 4096, "", "haswell")
    record = Record(TRIPLE, b"znver3")
    page = mmap.mmap(-1, mmap.PAGESIZE)
    page.write(bytes(record.words))
    view = ctypes.c_char.from_buffer(page)
    address = ctypes.addressof(view)
    libc = ctypes.CDLL(None, use_errno=True)
    assert libc.mprotect(ctypes.c_void_p(address), mmap.PAGESIZE, mmap.PROT_READ) == 0
    assert not pocl.pair_record(address, version("znver3"), "haswell")
    assert record.text(1) == b"znver3"
    assert libc.mprotect(ctypes.c_void_p(address), mmap.PAGESIZE, 3) == 0
    del view
    page.close()


def device(
    platform_version: str,
    record: Record,
    name: str = "Portable Computing Language",
    cpu: str = "znver3",
) -> types.SimpleNamespace:
    """As much of a device as the pairing asks for."""
    return types.SimpleNamespace(
        platform=types.SimpleNamespace(name=name, version=platform_version),
        version=version(cpu),
        int_ptr=record.address,
        parent_device=None,
    )


WHEEL = "OpenCL 3.0 PoCL 3.0-rc2  Linux, Release, RELOC, LLVM 14.0.6, SLEEF, DISTRO, POCL_DEBUG"


@pytest.mark.parametrize(
    ("platform_version", "paired"),
    [
        (WHEEL, True),
        (WHEEL.replace("PoCL 3.0-rc2", "PoCL 3.1+debian"), True),
        (WHEEL.replace("PoCL 3.0-rc2", "PoCL 4.0"), True),
        (WHEEL.replace("PoCL 3.0-rc2", "PoCL 5.0"), False),
        (WHEEL.replace("PoCL 3.0-rc2", "PoCL 10.1"), False),
        (WHEEL.replace(" DISTRO,", ""), False),
        ("OpenCL 3.0 LINUX", False),
    ],
)
def test_old_pocls_with_variants_are_paired_and_others_left_alone(
    platform_version, paired, monkeypatch
):
    monkeypatch.setattr(pocl, "cpu_flags", lambda: frozenset(HASWELL.split()))
    record = Record(TRIPLE, b"znver3")
    options = pocl.build_options([device(platform_version, record)])
    assert options == (["-DCLRA_POCL_CPU=haswell"] if paired else [])
    assert record.text(1) == (b"haswell" if paired else b"znver3")
    other = Record(TRIPLE, b"znver3")
    assert pocl.build_options([device(platform_version, other, name="Other")]) == []
    gpu = device(platform_version, other)
    gpu.version = "OpenCL 3.0 PoCL HSTR: CUDA-sm_90"
    assert pocl.build_options([gpu]) == []
    assert other.text(1) == b"znver3"


def test_a_device_that_has_the_right_name_is_left_alone(monkeypatch):
    monkeypatch.setattr(pocl, "cpu_flags", lambda: frozenset(HASWELL.split()))
    record = Record(TRIPLE, b"avx2", b"haswell")
    before = bytes(record.words)
    assert pocl.build_options([device(WHEEL, record, cpu="haswell")]) == ["-DCLRA_POCL_CPU=haswell"]
    assert bytes(record.words) == before


def test_a_sub_device_is_paired_with_its_parent(monkeypatch):
    monkeypatch.setattr(pocl, "cpu_flags", lambda: frozenset(HASWELL.split()))
    part, whole = Record(TRIPLE, b"znver3"), Record(TRIPLE, b"znver3")
    sub = device(WHEEL, part)
    sub.parent_device = device(WHEEL, whole)
    pocl.build_options([sub])
    assert (part.text(1), whole.text(1)) == (b"haswell", b"haswell")


def test_where_it_cannot_be_paired_it_says_what_to_install(monkeypatch):
    monkeypatch.setattr(pocl, "cpu_flags", lambda: frozenset(HASWELL.split()))
    strange = device(WHEEL, Record(b"x86_64", b"generic"))
    with pytest.warns(ClraWarning, match="install PoCL 5.0 or newer"):
        assert pocl.build_options([strange]) == []


def test_the_real_record_is_paired():
    name = pocl.cpu_of_variant(pocl.cpu_flags())
    listed = [devices.device_at(info.index) for info in devices.devices()]
    old = [device for device in listed if pocl.needs_pairing(device)]
    if not old:
        pytest.skip("no PoCL before 5.0 whose built-ins come in variants")
    for real in old:
        assert pocl.build_options([real]) == [f"-DCLRA_POCL_CPU={name}"]
        # The name is found again as the word after the triple, or after Debian's variant.
        words = (ctypes.c_void_p * 256).from_address(real.int_ptr)
        memory = pocl._Memory.of_process()
        texts = [memory.text(word).decode(errors="replace") for word in words]
        place = next(i for i, text in enumerate(texts) if re.fullmatch(r"x86_64-.*", text))
        assert name in texts[place + 1 : place + 3]
