"""Commands in a process of their own, without a terminal."""

import os
import signal
import subprocess
import sys

import pytest

CLRA = (sys.executable, "-P", "-m", "clra.app.cli")


def run(*arguments, **options):
    done = subprocess.run(
        [*CLRA, *map(str, arguments)], capture_output=True, text=True, timeout=120, **options
    )
    return done.returncode, done.stdout, done.stderr


def test_devices_are_listed_and_nothing_heavy_is_imported():
    code = (
        "import sys; from clra.app.cli import app; "
        "import clra.ops.runtime.devices, clra.ops.runtime.build; "
        "heavy = {'matplotlib', 'scipy', 'h5py', 'rich', 'nxtomo', 'reikna'} & set(sys.modules); "
        "sys.exit(', '.join(sorted(heavy)) or 0)"
    )
    done = subprocess.run([sys.executable, "-P", "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    code, out, err = run("devices")
    assert (code, err) == (0, "") and out


def test_debug_adds_a_traceback_on_either_side_of_the_command():
    for arguments in (["--debug", "info", "none.nxs"], ["info", "none.nxs", "--debug"]):
        code, out, err = run(*arguments)
        assert code == 2 and out == ""
        assert "Traceback" in err and err.splitlines()[-1].startswith("error: none.nxs")
    code, _, err = run("info", "none.nxs")
    assert code == 2 and err.count("\n") == 1


@pytest.mark.skipif(os.name == "nt", reason="signals work otherwise there")
@pytest.mark.parametrize("sent", [signal.SIGINT, signal.SIGTERM])
def test_ctrl_c_ends_with_130_and_leaves_no_file(sent, tmp_path):
    process = subprocess.Popen(
        [*CLRA, "simulate", str(tmp_path / "s.nxs"), "--views", "3456", "--detector", "928x512"],
        stderr=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        # a shell's background job ignores Ctrl-C, and its children inherit that
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    )
    assert process.stderr is not None
    assert process.stderr.readline().startswith("writing: ")
    assert any(tmp_path.iterdir())
    process.send_signal(sent)
    out, err = process.communicate(timeout=60)
    assert process.returncode == 130, err
    assert out == "" and err.splitlines()[-1].startswith("interrupted: ")
    assert list(tmp_path.iterdir()) == []
