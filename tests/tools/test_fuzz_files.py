"""A short run of the fuzzer, by its command line, and what counts as a library's fault."""

import subprocess
import sys
from pathlib import Path

import pytest

from clra.errors import InputError
from clra.io.damage import readable

TOOL = Path(__file__).parents[2] / "tools" / "fuzz_files.py"


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="limits workers as Linux does")
def test_damaged_files_are_read_or_refused_by_name() -> None:
    done = subprocess.run(
        [sys.executable, TOOL, "--files", "60", "--seed", "1"],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    counts = {name: int(n) for name, n in (part.split(": ") for part in done.stdout.split(", "))}
    assert sum(counts.values()) == 60 and counts["read"] > 10 and counts["refused"] > 10


def test_only_what_a_library_raises_is_the_files_fault(tmp_path: Path) -> None:
    import h5py

    damaged = tmp_path / "a.h5"
    damaged.write_bytes(b"\x89HDF\r\n\x1a\n" + bytes(99))
    with pytest.raises(InputError, match=r"a\.h5: cannot be read: .*copy it again"):
        with readable(damaged):
            h5py.File(damaged)
    with pytest.raises(ZeroDivisionError), readable(damaged):
        1 / 0  # noqa: B018  (what our own code might raise)
    with pytest.raises(InputError, match=r"^as it is$"), readable(damaged):
        raise InputError("as it is")
