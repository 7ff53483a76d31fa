"""The paper's Figure 4 at a 32nd of its size, from HDF5 to HDF5 by the command line."""

import importlib.util
import json
import sys
from pathlib import Path

import numpy as np
import pytest
from alignments import keep_motion

from clra.io.scan_files import read_scan, write_scan
from clra.io.volumes.volume_files import read_volume
from clra.model.grid import default_grid
from clra.model.scan import Scan

SCALE = 32
MAE = 0.25  # pixel
CLOSE = 1.1  # times the RMSE with the true motion
TOOL = Path(__file__).parents[2] / "tools" / "figure4_small.py"


@pytest.fixture(scope="module")
def figure():
    spec = importlib.util.spec_from_file_location("figure4_small", TOOL)
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # for the processes that it starts
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def wood(figure):
    geometry = figure.geometry_of(SCALE)
    truth = figure.stage_motion(geometry)
    images = figure.radiographs(figure.core_of(geometry), geometry.with_motion(truth))
    return Scan(images, geometry, name="wood", truth=truth)


def test_the_scan_is_the_papers(figure, wood):
    assert figure.geometry_of(1).views == 14136
    half = wood.views // 2
    truth = wood.truth
    assert np.abs(truth.shift_u).max() == pytest.approx(4, abs=0.4)
    assert np.abs(truth.shift_v).max() == pytest.approx(3, abs=0.5)
    assert np.abs(truth.magnification - 1).max() == pytest.approx(1e-3, abs=2e-4)
    # What a movement of the sample explains was taken out, which hardly touches the mirror.
    for values in (truth.shift_u, truth.shift_v, truth.magnification):
        assert np.abs(values[:half] - values[half:][::-1]).max() < 0.1
    fan = 2 * np.degrees(np.arcsin(figure.RADIUS / 0.9 / figure.SOURCE_TO_AXIS))
    assert fan == pytest.approx(67.6, abs=0.5)


def test_align_and_reconstruct_by_one_command(figure, wood, tmp_path, clra):
    """Chain `--align`; then `--motion` with the true one, and no motion, to compare with."""
    path, known = tmp_path / "wood.nxs", tmp_path / "motion.h5"
    write_scan(path, wood)
    keep_motion(known, wood.truth)
    grid = default_grid(read_scan(path).geometry)
    truth = figure.core_of(wood.geometry).volume(grid)
    volumes = {}
    for name, options in (("aligned", ["--align"]), ("true", ["--motion", known]), ("raw", [])):
        out = tmp_path / f"{name}.h5"
        status, _, err = clra(
            "reconstruct", path, "-o", out, "--method", "katsevich", *options, "--quiet"
        )
        assert status == 0, err
        volumes[name] = read_volume(out)[0]
    held = volumes["true"] != 0
    assert held.mean() > 0.4
    rmse = {name: figure.rmse(volume, truth, held) for name, volume in volumes.items()}
    assert rmse["aligned"] < CLOSE * rmse["true"]
    assert rmse["raw"] > 1.5 * rmse["true"]


def test_shifts_and_report(wood, tmp_path, clra):
    path, motion, page = (tmp_path / name for name in ("wood.nxs", "motion.h5", "report.html"))
    write_scan(path, wood)
    status, out, _ = clra(
        "align", path, "-o", motion, "--schedule", "4QR-2HR", "--report", page, "--json", "--quiet"
    )
    assert status == 0
    found = json.loads(out)
    assert found["mae_u"] < MAE and found["mae_v"] < MAE
    text = page.read_text(encoding="utf-8")
    assert "reconstructed by Katsevich" in text
    assert "mirrored about the middle" in text


@pytest.mark.parametrize("options", [[], ["--align"]])
def test_what_katsevich_cannot_treat_ends_with_one_line(scan_file, tmp_path, clra, options):
    out = tmp_path / "volume.h5"
    status, _, err = clra(
        "reconstruct", scan_file, "-o", out, "--method", "katsevich", "--quiet", *options
    )
    assert status == 2
    assert len(err.strip().splitlines()) == 1
    assert "degrees from view to view, expected a helix" in err and "use method 'fbp'" in err
    assert not list(tmp_path.iterdir())
