"""A cluster of two workers, and scans in files that they read."""

import numpy as np
import pytest

import clra
from clra.app.simulation import paper_like, sample, simulated_scan


@pytest.fixture(scope="session")
def client(tmp_path_factory):
    distributed = pytest.importorskip("distributed")
    folder = tmp_path_factory.mktemp("dask")
    with (
        distributed.LocalCluster(
            n_workers=2,
            threads_per_worker=1,
            memory_limit=None,
            dashboard_address=":0",
            silence_logs=50,
            local_directory=str(folder),
        ) as cluster,
        distributed.Client(cluster, set_as_default=False) as client,
    ):
        yield client


@pytest.fixture(autouse=True)
def _own_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


def scan_file(path, kind, views, size=64):
    geometry = paper_like(kind, views, (size, size))
    random = np.random.default_rng(3)
    truth = clra.Motion(
        shift_u=random.normal(0, 1, views),
        shift_v=random.normal(0, 1, views),
        magnification=np.ones(views),
    )
    clra.write_scan(path, simulated_scan(geometry, sample("spheres", geometry), truth, name=kind))
    return clra.read_scan(path)


@pytest.fixture(scope="session")
def scans(tmp_path_factory):
    folder = tmp_path_factory.mktemp("scans")
    # As few views a turn as Katsevich's method takes.
    views = {"helix": 320, "space-filling": 160}
    return {kind: scan_file(folder / f"{kind}.nxs", kind, n) for kind, n in views.items()}


@pytest.fixture(scope="session")
def small_scan(tmp_path_factory):
    return scan_file(tmp_path_factory.mktemp("scans") / "small.nxs", "helix", 96, size=40)


@pytest.fixture(scope="session")
def few_views(tmp_path_factory):
    return scan_file(tmp_path_factory.mktemp("scans") / "few.nxs", "space-filling", 96)
