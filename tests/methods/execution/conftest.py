"""Workers of a cluster on this machine, and scans in files for them."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import clra
from clra.app.simulation import paper_like, sample, simulated_scan


@pytest.fixture(scope="session")
def client(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    """Connected to two workers."""
    distributed = pytest.importorskip("distributed")
    with (
        distributed.LocalCluster(
            n_workers=2,
            threads_per_worker=1,
            memory_limit=None,
            dashboard_address=":0",
            silence_logs=50,
            local_directory=str(tmp_path_factory.mktemp("dask")),
        ) as cluster,
        distributed.Client(cluster, set_as_default=False) as client,
    ):
        yield client


@pytest.fixture
def own_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Leave what is written to the current folder where the test can look at it."""
    monkeypatch.chdir(tmp_path)


@pytest.fixture(scope="session")
def scan_file(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str, int, int], clra.Scan]:
    """Write and read a scan of spheres: kind of trajectory, views, columns."""

    def written(kind: str, views: int, size: int) -> clra.Scan:
        geometry = paper_like(kind, views, (size, size))
        random = np.random.default_rng(3)
        truth = clra.Motion(
            shift_u=random.normal(0, 1, views),
            shift_v=random.normal(0, 1, views),
            magnification=np.ones(views),
        )
        scan = simulated_scan(geometry, sample("spheres", geometry), truth, name=kind)
        path = tmp_path_factory.mktemp("scans") / f"{kind}.nxs"
        clra.write_scan(path, scan)
        return clra.read_scan(path)

    return written
