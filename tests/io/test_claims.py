import os
import subprocess
import sys
from pathlib import Path

import pytest

from clra.errors import InputError, OutputError
from clra.io.atomic import atomic_path, ensure_writable
from clra.io.claims import one_run

HOLD = """
import sys
from pathlib import Path
from clra.io.atomic import atomic_path
with atomic_path(sys.argv[1]) as temporary:
    temporary.write_text("theirs")
    print("holding", flush=True)
    sys.stdin.read()
"""


@pytest.fixture
def other(tmp_path: Path):
    """Another process that is writing out.h5 until its stdin ends."""
    with subprocess.Popen(
        [sys.executable, "-c", HOLD, tmp_path / "out.h5"],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
    ) as process:  # fmt: skip
        assert process.stdout is not None and process.stdin is not None
        assert process.stdout.readline() == "holding\n"
        yield process
        process.kill()


def test_two_runs_do_not_write_one_output(tmp_path: Path, other: subprocess.Popen[str]) -> None:
    target = tmp_path / "out.h5"
    with pytest.raises(OutputError, match=r"out\.h5: another run is writing it"):
        with atomic_path(target):
            pytest.fail("must not get here")
    with one_run(), pytest.raises(OutputError, match="another run is writing it"):
        ensure_writable(target)
    other.communicate()
    assert other.returncode == 0 and target.read_text() == "theirs"
    with atomic_path(target) as temporary:
        temporary.write_text("ours")
    assert target.read_text() == "ours" and os.listdir(tmp_path) == ["out.h5"]


def test_what_a_killed_run_left_is_removed(tmp_path: Path, other: subprocess.Popen[str]) -> None:
    other.kill()
    other.wait()
    left = sorted(os.listdir(tmp_path))
    assert left == [f".out.h5.{other.pid}.part", ".out.h5.lock"]
    with atomic_path(tmp_path / "out.h5") as temporary:
        temporary.write_text("ours")
    assert os.listdir(tmp_path) == ["out.h5"]


def test_an_output_is_held_from_its_check_to_the_end_of_the_run(tmp_path: Path) -> None:
    target = tmp_path / "out.h5"
    with one_run():
        ensure_writable(target)
        done = subprocess.run(
            [sys.executable, "-c", HOLD, target], capture_output=True, text=True, check=False
        )
        assert done.returncode == 1 and "another run is writing it" in done.stderr
        for text in ("once", "twice"):
            with atomic_path(target) as temporary:
                temporary.write_text(text)
    assert target.read_text() == "twice" and os.listdir(tmp_path) == ["out.h5"]


def test_what_is_there_is_kept_where_that_is_wanted(tmp_path: Path) -> None:
    target, new = tmp_path / "out.h5", tmp_path / "new.h5"
    target.write_text("old")
    with one_run(overwrite=False):
        for check in (ensure_writable, lambda path: atomic_path(path).__enter__()):
            with pytest.raises(InputError, match=r"out\.h5: it is there already"):
                check(target)
        for text in ("once", "twice"):  # its own may be replaced
            with atomic_path(new) as temporary:
                temporary.write_text(text)
        # Another program makes it after it was looked for.
        with pytest.raises(InputError, match="there already"), atomic_path(tmp_path / "x"):
            (tmp_path / "x").write_text("theirs")
    assert target.read_text() == "old" and new.read_text() == "twice"
    assert (tmp_path / "x").read_text() == "theirs"
