"""Where things are kept between runs, and what if nothing can be kept there."""

import os
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

from clra.errors import ClraWarning, DeviceError
from clra.ops.runtime import cache_folder, devices


@pytest.fixture(autouse=True)
def home(monkeypatch, tmp_path):
    """A home folder of its own; the process's variables come back."""
    for name in ("XDG_CACHE_HOME", "POCL_CACHE_DIR", "TMPDIR"):
        monkeypatch.setenv(name, "")  # remembered, for what the code sets is undone as well
        monkeypatch.delenv(name)
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    (tmp_path / "tmp").mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "tmp"))
    cache_folder.cache_folder.cache_clear()
    yield tmp_path / "home"
    cache_folder.cache_folder.cache_clear()


@pytest.mark.skipif(sys.platform != "linux", reason="other systems have other conventions")
def test_the_systems_convention(home, monkeypatch, tmp_path):
    assert cache_folder.cache_folder() == home / ".cache" / "clra"
    assert (home / ".cache" / "clra").is_dir()
    cache_folder.cache_folder.cache_clear()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "else"))
    assert cache_folder.cache_folder() == tmp_path / "else" / "clra"


def test_a_file_in_place_of_the_home_folder_is_named_and_stood_in_for(home, tmp_path):
    home.write_text("")
    with pytest.warns(ClraWarning, match=rf"{home}.*: {home} is not a folder: .* set XDG_CACHE"):
        folder = cache_folder.cache_folder()
    assert folder.is_relative_to(tmp_path / "tmp") and folder.is_dir()
    assert folder.parent.stat().st_mode & 0o077 == 0
    assert os.environ["XDG_CACHE_HOME"] == str(folder.parent)
    assert cache_folder.cache_folder() == folder  # warned of once


def test_a_pocl_folder_that_cannot_be_made_is_stood_in_for(home, monkeypatch, tmp_path):
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("POCL_CACHE_DIR", str(tmp_path / "file" / "pocl"))
    with pytest.warns(ClraWarning, match="file is not a folder"):
        cache_folder.cache_folder()
    assert "POCL_CACHE_DIR" not in os.environ


def test_a_full_disk_is_no_place(home, monkeypatch):
    home.mkdir()
    assert cache_folder.unusable(home) == ""
    monkeypatch.setattr(cache_folder, "ROOM", 1 << 60)
    assert cache_folder.unusable(home) == f"less than {1 << 40} MiB are free"


@pytest.mark.skipif(sys.platform != "linux", reason="needs a device that is always full")
def test_a_folder_that_cannot_be_written_to_is_no_place():
    assert cache_folder.unusable(Path("/proc/self/none")) != ""
    assert cache_folder.unusable(Path("/dev/full")) == "not a folder"


def test_somebody_elses_temporary_folder_is_not_used(home, tmp_path):
    home.write_text("")
    own = tmp_path / "tmp" / f"clra-{os.getuid()}"
    own.mkdir(mode=0o777)
    own.chmod(0o777)
    with pytest.warns(ClraWarning):
        folder = cache_folder.cache_folder()
    assert folder.parent != own and folder.parent.stat().st_mode & 0o077 == 0


def test_where_nothing_can_be_written_both_folders_are_named(home, monkeypatch, tmp_path):
    home.write_text("")
    file = tmp_path / "tmp" / "file"
    file.write_text("")
    monkeypatch.setattr(tempfile, "tempdir", str(file))
    with pytest.raises(DeviceError, match=rf"no folder for compiled .*{home}.*{file}.*XDG_CACHE"):
        cache_folder.cache_folder()
    monkeypatch.setattr(devices.cl, "get_platforms", list)
    with pytest.raises(DeviceError, match="no folder for compiled kernels"):
        devices.choose_device()  # and not "no OpenCL device"


def test_devices_work_without_a_home_folder(home):
    home.write_text("")
    code = (
        "from clra.ops.runtime import devices; import numpy as np, pyopencl as cl, pyopencl.array;"
        "from clra.ops.images.pyramid import Restrict2D;"
        "context = cl.Context([devices.choose_device()]); queue = cl.CommandQueue(context);"
        "images = cl.array.zeros(queue, (2, 8, 8), np.float32);"
        "halved = cl.array.zeros(queue, (2, 4, 4), np.float32);"
        "Restrict2D(context)(queue, halved, images).wait(); print('done')"
    )
    done = subprocess.run(
        [sys.executable, "-P", "-W", "always", "-c", code],
        capture_output=True,
        text=True,
        env=os.environ | {"TMPDIR": tempfile.gettempdir()},
    )
    assert (done.returncode, done.stdout) == (0, "done\n"), done.stderr
    assert f"ClraWarning: {home}" in done.stderr
