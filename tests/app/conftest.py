"""A tiny simulated scan in a file, and an alignment of it that was made up."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from typer.main import get_command

from clra.app.annotations import annotated
from clra.app.cli import app
from clra.app.simulation import paper_like, sample, simulated_motion, simulated_scan
from clra.findings import Finding
from clra.io.alignment_file import write_alignment
from clra.io.scan_files import write_scan
from clra.methods.alignment.result import AlignmentResult, Iteration
from clra.model.motion import Motion
from clra.model.scan import Scan

VIEWS, SHAPE = 24, (41, 33)
FLAGGED = (3, 17)


@pytest.fixture(scope="session")
def scan() -> Scan:
    geometry = paper_like("space-filling", VIEWS, SHAPE)
    truth = simulated_motion("random", geometry, shift=(-2.0, 2.0), magnification=0.001)
    return simulated_scan(geometry, sample("spheres", geometry), truth, name="tiny")


@pytest.fixture(scope="session")
def scan_file(scan: Scan, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("scan") / "tiny.nxs"
    write_scan(path, scan)
    return path


@pytest.fixture(scope="session")
def result(scan: Scan) -> AlignmentResult:
    random = np.random.default_rng(0)
    truth = scan.truth
    assert truth is not None
    confidence = random.uniform(0.9, 1.0, VIEWS)
    confidence[list(FLAGGED)] = 0
    return AlignmentResult(
        motion=Motion(
            shift_u=truth.shift_u + random.normal(0, 0.1, VIEWS),
            shift_v=truth.shift_v + random.normal(0, 0.1, VIEWS),
            magnification=truth.magnification,
        ),
        history=(
            Iteration("QR", 1, 1.5, 1.4, 3.9, 0.8, 0.05, 2.0, note="few features\n3 < 4 views"),
            Iteration("HR", 1, 0.2, 0.1, 0.4, 0.9, 0.04, 8.0, 0.1, 0.1, 1e-4, 0.05, 0.05, 1e-4),
        ),
        confidence=confidence,
        sigma=np.tile([0.01, 0.02, 1e-4], (VIEWS, 1)),
        gauge={"translation x": 0.25, "tilt y": 0.125},
        valid_views=confidence > 0,
        estimate="shift+scale",
        warnings=(Finding("note", "few features"), Finding("note", "3 < 4 views")),
        checksum=scan.checksum(),
        scan=scan.name,
        versions={"clra": "0.0.1", "driver": "1"},
        about={"unobservable": "taken out"},
        schedule="1QR-1HR",
        device="a device",
    )


@pytest.fixture(scope="session")
def record(result: AlignmentResult, scan: Scan) -> AlignmentResult:
    return annotated(result, scan, command="clra align <scan>.nxs")


@pytest.fixture
def motion_file(record: AlignmentResult, tmp_path: Path) -> Path:
    path = tmp_path / "motion.h5"
    write_alignment(path, record)
    return path


@pytest.fixture
def clra(capsys: pytest.CaptureFixture[str]) -> Callable[..., tuple[int, str, str]]:
    """Run a command in this process: exit status, stdout, stderr."""

    def run(*arguments: object) -> tuple[int, str, str]:
        with pytest.raises(SystemExit) as done:
            get_command(app).main([str(argument) for argument in arguments])
        out, err = capsys.readouterr()
        assert isinstance(done.value.code, int)
        return done.value.code, out, err

    return run
