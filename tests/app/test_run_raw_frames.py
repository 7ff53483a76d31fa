"""All steps in one go on raw frames of real and of independently simulated scans."""

from pathlib import Path

import numpy as np
import pytest

from clra.io.alignment_file import read_alignment
from clra.io.volumes.volume_files import read_volume

# Coarse, so that it is quick.
CONFIG = """
{importing}
[align]
schedule = "1QR"
[reconstruct]
bin = 4
"""
# A parallel beam and half a turn: what the frames of the synchrotron do not tell.
FRAMES = """
[import]
angles = "-88.2:91.8:91"
parallel = true
detector-distance = 10.0
pixel-size = 1.0
flat = ["{folder}/flat_00001.tiff"]
dark = ["{folder}/dark_00001.tiff"]
centre-offset = "6.25"
"""


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::clra.errors.ClraWarning")
@pytest.mark.parametrize("name", ["ctsimu_tetrahedron", "dls_24737/image_test"])
def test_raw_frames_give_what_the_single_commands_give(data: Path, clra, tmp_path, name) -> None:
    frames, config, importing = data / name, tmp_path / "scan.toml", ""
    if "dls" in name:
        frames, importing = frames / "tiffs" / "*.tiff", FRAMES.format(folder=data / name)
    config.write_text(CONFIG.format(importing=importing))
    given = ("--config", config, "-q")
    one, all_of_it = tmp_path / "one", tmp_path / "all"
    one.mkdir()
    status, _, error = clra("run", frames, "-o", all_of_it, *given)
    assert status == 0, error
    scan, motion = one / "scan.nxs", one / "motion.h5"
    for command in (
        ("import", frames, "-o", scan),
        ("align", scan, "-o", motion),
        ("reconstruct", scan, "--motion", motion, "-o", one / "volume.h5"),
    ):
        status, _, error = clra(*command, *given)
        assert status == 0, error
    found, expected = (read_alignment(f / "motion.h5").motion for f in (all_of_it, one))
    assert found == expected
    volumes = [read_volume(folder / "volume.h5")[0] for folder in (all_of_it, one)]
    assert np.array_equal(*volumes) and volumes[0].std() > 0
    assert (all_of_it / "report.html").stat().st_size < 5e6
