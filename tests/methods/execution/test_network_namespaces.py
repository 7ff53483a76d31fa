"""Workers on machines of their own, as far as one machine has such: only a folder is shared.

Each worker has its own network, joined to the scheduler's by a cable, and its own inter-process
communication, shared memory and temporary files.
"""

import shutil
import subprocess
import sys

import pytest

pytest.importorskip("distributed")

MACHINES = r"""
import os, subprocess, sys, time
import numpy as np
import distributed
import clra
from clra.app.simulation import paper_like, sample, simulated_scan

folder = os.getcwd()
WORKER = '''
mkdir -p {own}; mount -t tmpfs tmpfs /dev/shm; mount -t tmpfs tmpfs {own}
touch {own}/begun; until ip link show eth0 >/dev/null 2>&1; do sleep 0.05; done
ip link set lo up; ip addr add 10.77.{n}.2/30 dev eth0; ip link set eth0 up
ip route add default via 10.77.{n}.1
cd {own}; TMPDIR={own} exec {python} -m distributed.cli.dask_worker tcp://10.77.{n}.1:8786 \
    --nthreads 1 --no-nanny --no-dashboard --local-directory {own}
'''


def run(*command):
    subprocess.run(command, check=True)


processes = []
try:
    run("ip", "link", "set", "lo", "up")
    scheduler = [sys.executable, "-m", "distributed.cli.dask_scheduler", "--host", "0.0.0.0"]
    processes.append(subprocess.Popen([*scheduler, "--port", "8786", "--no-dashboard"]))
    for n in range(2):
        script = WORKER.format(n=n, own=f"{folder}/machine{n}", python=sys.executable)
        alone = ["unshare", "--net", "--ipc", "--mount", "sh", "-c", script]
        processes.append(subprocess.Popen(alone))
        own = os.readlink("/proc/self/ns/net")
        while os.readlink(f"/proc/{processes[-1].pid}/ns/net") == own:
            time.sleep(0.05)
        ends = ["type", "veth", "peer", "name", "eth0", "netns", str(processes[-1].pid)]
        run("ip", "link", "add", f"cable{n}", *ends)
        run("ip", "addr", "add", f"10.77.{n}.1/30", "dev", f"cable{n}")
        run("ip", "link", "set", f"cable{n}", "up")

    geometry = paper_like("helix", 320, (64, 64))
    random = np.random.default_rng(3)
    u, v = random.normal(0, 1, (2, 320))
    truth = clra.Motion(shift_u=u, shift_v=v, magnification=np.ones(320))
    made = simulated_scan(geometry, sample("spheres", geometry), truth, name="helix")
    clra.write_scan("scan.nxs", made)
    scan = clra.read_scan("scan.nxs")
    with distributed.Client("tcp://127.0.0.1:8786", timeout=60) as client:
        client.wait_for_workers(2, timeout=60)
        hosts = {address.split(":")[1] for address in client.nthreads()}
        assert hosts == {"//10.77.0.2", "//10.77.1.2"}, hosts
        options = {"schedule": "1QR-1HR", "quality": False}
        shared = clra.align(scan, cluster=client, **options)
        volume = clra.reconstruct(scan, alignment=shared, cluster=client)
    alone = clra.align(scan, **options)
    for one, other in zip(shared.motion.columns(), alone.motion.columns()):
        assert abs(one - other).max() < 1e-4
    expected = clra.reconstruct(scan, alignment=shared)
    assert np.linalg.norm(volume - expected) < 3e-6 * np.linalg.norm(expected)
finally:
    for process in processes:
        process.kill()  # workers that end as their scheduler ends may well hang
print("two machines")
"""


def test_workers_that_share_a_folder_only(tmp_path):
    if not all(map(shutil.which, ("unshare", "ip", "mount"))):
        pytest.skip("no unshare, ip or mount")
    own = ["unshare", "--user", "--map-root-user", "--net", "--mount"]
    tried = subprocess.run(
        [*own, "ip", "link", "add", "one", "type", "veth", "peer", "name", "two"],
        capture_output=True,
    )
    if tried.returncode:
        pytest.skip("no network namespaces of one's own")
    done = subprocess.run(
        [*own, sys.executable, "-c", MACHINES], cwd=tmp_path, capture_output=True, text=True
    )
    assert done.stdout.strip() == "two machines", done.stderr
