"""The tool of the paper's figures, by its command line, at a sixteenth of the size."""

import json
import runpy
import sys
from pathlib import Path

import matplotlib.image
import numpy as np
import pytest

TOOLS = Path(__file__).parents[2] / "tools"
# Motions of 10 pixels carry the sample out of detectors as small as these.
pytestmark = pytest.mark.filterwarnings("ignore:the sample reaches beyond the detector")


@pytest.fixture(scope="module")
def tool():
    """Run the tool with some arguments, as from a shell."""

    def run(*arguments):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(sys, "argv", ["reproduce_figure3.py", *map(str, arguments)])
            patch.syspath_prepend(TOOLS)
            runpy.run_path(str(TOOLS / "reproduce_figure3.py"), run_name="__main__")

    return run


@pytest.fixture(scope="module")
def folder(tool, tmp_path_factory):
    """What one call leaves; at this size a detector has no quarter of 16 pixels, only a half."""
    made = tmp_path_factory.mktemp("figures")
    tool("--scale", 16, "--schedules", "1HR", "-o", made)
    return made


def runs_in(folder):
    return json.loads((folder / "runs.json").read_text())


def test_every_scan_is_aligned_by_both_estimators_and_kept(folder):
    runs = runs_in(folder)
    for trajectory in ("helix", "space-filling"):
        for motion in ("random", "smooth"):
            errors = {}
            for who in ("ours", "paper"):
                found = runs[f"16 {trajectory} {motion} {who} 1HR"]
                assert [step["level"] for step in found["iterations"]] == ["HR"]
                errors[who] = found["gauge_free_u"]
            # A third of this detector's width is far for one iteration: motions are 4.5 pixels.
            assert 0 < errors["ours"] < errors["paper"] < 5
    assert len(runs) == 8


def test_started_again_it_runs_what_is_missing_alone(tool, folder, capsys):
    before = runs_in(folder)
    tool("--scale", 16, "--schedules", "1HR", "-o", folder)
    assert runs_in(folder) == before  # with the seconds that each took
    table = [line for line in capsys.readouterr().out.splitlines() if line.startswith("| 16 ")]
    assert len(table) == 8
    missing = "16 helix smooth ours 1HR"
    rest = {key: found for key, found in before.items() if key != missing}
    rest["16 helix smooth no Anderson"] = before[missing]  # an ablation, which is not drawn
    (folder / "runs.json").write_text(json.dumps(rest))
    tool("--scale", 16, "--schedules", "1HR", "-o", folder)
    after = runs_in(folder)
    assert {key: after[key] for key in rest} == rest
    assert after[missing]["seconds"] != before[missing]["seconds"]
    assert after[missing]["mae_v"] == pytest.approx(before[missing]["mae_v"], rel=1e-3)


def test_its_picture_is_drawn(folder):
    (picture,) = folder.glob("*.png")
    image = matplotlib.image.imread(picture)
    assert image.shape[0] > 300 and image.shape[1] > 600
    assert np.ptp(image) > 0.5


def test_radiographs_are_on_disk_whole(folder):
    paths = [path for path in folder.glob("*.npy") if "slice" not in path.name]
    images = [np.load(path, mmap_mode="r") for path in paths]
    assert [image.shape for image in images] == 4 * [(216, 58, 32)]
    assert not list(folder.glob("*.partial"))
    assert all(image[::20].max(axis=(1, 2)).min() > 0 for image in images)
