"""Commands keep inside the memory that they are given, from file to file."""

import subprocess
import sys

import numpy as np
import pytest

from clra.app.simulation import paper_like, sample, simulated_scan
from clra.io.scan_files import write_scan
from clra.io.volumes.volume_files import read_volume
from clra.model.motion import Motion

MIB = 1 << 20
HOST, DEVICE = 24, 12  # MiB
# Runs a command and tells the largest resident size of its process. (ru_maxrss begins with that of
# the process that started it.)
RUN = """
import atexit, pathlib
status = pathlib.Path("/proc/self/status")
atexit.register(lambda: print(status.read_text().partition("VmHWM:")[2].split()[0]))
from clra.app.cli import main
main()
"""


def _scan(path, views, detector):
    geometry = paper_like("helix", views, detector)
    truth = Motion.identity(views)
    write_scan(path, simulated_scan(geometry, sample("spheres", geometry), truth, name=path.name))
    return path


def _peak(*arguments):
    """Bytes that the process of a command took at most."""
    command = [sys.executable, "-c", RUN, *map(str, arguments), "--quiet"]
    done = subprocess.run(command, check=True, capture_output=True, text=True)
    return int(done.stdout.split()[-1]) << 10


@pytest.fixture(scope="module")
def scans(tmp_path_factory):
    """A scan larger than the host's budget, as is its volume, and a tiny one of its kind."""
    folder = tmp_path_factory.mktemp("memory")
    large = _scan(folder / "large.nxs", 340, (196, 172))
    assert large.stat().st_size > 1.5 * HOST * MIB
    return large, _scan(folder / "tiny.nxs", 320, (64, 64))


@pytest.mark.skipif(sys.platform != "linux", reason="reads the peak as Linux tells it")
@pytest.mark.parametrize(
    ("command", "out", "options"),
    [
        ("reconstruct", "volume.h5", []),
        ("reconstruct", "exact.h5", ["--method", "katsevich"]),
        ("align", "motion.h5", ["--schedule", "1QR-1HR"]),
    ],
)
def test_a_scan_larger_than_the_memory(scans, tmp_path, clra, command, out, options):
    large, tiny = scans
    limits = ["--max-host-memory", f"{HOST}M", "--max-device-memory", f"{DEVICE}M"]
    alone = _peak(command, tiny, "-o", tmp_path / f"tiny-{out}", *options, *limits)
    peak = _peak(command, large, "-o", tmp_path / out, *options, *limits)
    assert peak - alone < 1.05 * HOST * MIB
    if command == "reconstruct":
        assert (tmp_path / out).stat().st_size > 1.1 * HOST * MIB
        assert clra(command, large, "-o", tmp_path / f"free-{out}", *options, "--quiet")[0] == 0
        tight, free = (read_volume(tmp_path / name)[0] for name in (out, f"free-{out}"))
        assert np.linalg.norm(tight - free) < 1e-5 * np.linalg.norm(free)


@pytest.mark.parametrize("size", ["much", "-3G", "0", "12Q"])
def test_a_size_that_is_none(scan_file, tmp_path, clra, size):
    out = tmp_path / "v.h5"
    status, _, err = clra("reconstruct", scan_file, "-o", out, f"--max-host-memory={size}")
    assert status == 2
    assert f"--max-host-memory: found '{size}', expected a size such as 512M" in err
    assert not list(tmp_path.iterdir())
