"""What is asked of all radiographs workers find, and the caller reads none but a few."""

from functools import partial

import numpy as np
import pytest

import clra
from clra.methods.alignment.prealignment.axis_column import axis_column
from clra.methods.alignment.prealignment.prealignment import prealigned
from clra.methods.alignment.rejected_views import Rejections
from clra.methods.execution.dask_cluster import DaskCluster
from clra.methods.shared_work.shared_scan import SharedScan
from clra.model.gauge.gauge import Gauge, sample_points
from clra.model.grid import default_grid
from clra.model.phantoms.ellipsoids import Ellipsoids
from clra.ops.streaming.part_files import RadiographParts
from clra.ops.streaming.radiographs import Radiographs
from clra.ops.streaming.stream import Stream

VIEWS, BLANK = 60, 17


@pytest.fixture
def scan(tmp_path):
    """Balls on an arc of a parallel beam, the axis aside, and a blank view."""
    geometry = clra.circular(
        VIEWS,
        source_to_axis=5000.0,
        source_to_detector=10000.0,
        pixel_size=0.04,
        shape=(64, 64),
        arc=np.radians(200),
    )
    random = np.random.default_rng(2)
    walk = np.cumsum(random.normal(0, 0.6, (2, VIEWS)), axis=1)
    centres = random.uniform(-0.25, 0.25, (30, 3))
    balls = Ellipsoids(centres, random.uniform(0.03, 0.1, 30), random.uniform(1, 3, 30))
    motion = clra.Motion(shift_u=5 + 0.3 * walk[0], shift_v=walk[1])
    lines = balls.line_integrals(geometry.with_motion(motion))
    lines[BLANK] = 0.01
    clra.write_scan(tmp_path / "scan.nxs", clra.Scan(lines.astype(np.float32), geometry))
    return clra.read_scan(tmp_path / "scan.nxs")


@pytest.fixture
def reads(monkeypatch):
    """Numbers of views that this process reads at a time."""
    found = []

    def watched(read):
        def reading(self, start, stop, *rows, **options):
            found.append(stop - start)
            return read(self, start, stop, *rows, **options)

        return reading

    for kind in (clra.Scan, RadiographParts):
        monkeypatch.setattr(kind, "read", watched(kind.read))
    return found


def test_the_start_of_an_alignment(client, scan, reads, tmp_path):
    stream, geometry = Stream(), scan.geometry
    gauge = Gauge(geometry, sample_points(default_grid(geometry)), magnification=False)

    def begun(binned):
        rejections = Rejections(VIEWS)
        found = prealigned(stream, geometry, binned, 2, rejections, gauge)
        return found, rejections, axis_column(stream, scan, lambda: binned(1))

    executor = DaskCluster(client, tmp_path / "tasks")
    try:
        found, rejections, column = begun(partial(SharedScan(executor, scan).binned, stream))
        assert reads == []
    finally:
        executor.close()
    expected, others, at = begun(partial(Radiographs, stream, scan))
    assert max(reads) > 1
    assert found.motion == expected.motion and found.residual == expected.residual
    np.testing.assert_array_equal(found.known, expected.known)
    assert rejections.reasons == others.reasons and list(others.reasons) == [BLANK]
    assert column == at != 0


def test_an_alignment(client, scan, reads):
    stages = []
    shared = clra.align(
        scan,
        schedule="1HR",
        quality=False,
        cluster=client,
        progress=lambda p: stages.append(p.stage),
    )
    assert set(reads) == {1}
    assert "looking for blank radiographs" in stages
    assert not shared.valid_views[BLANK]
