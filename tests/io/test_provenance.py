"""Where outputs come from, as the files themselves tell it: read by h5py and tifffile."""

import json
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
import tifffile

import clra
from clra.io.provenance import provenance
from clra.io.volumes import tiff as tiff_files
from clra.methods.alignment.result import AlignmentResult
from clra.methods.reconstruction.osem_tr import OrderedSubsets

GRID = clra.VolumeGrid(shape=(2, 3, 4), voxel_size=0.5)


@pytest.fixture
def told() -> dict[str, str]:
    geometry = clra.circular(
        3, source_to_axis=5, source_to_detector=50, pixel_size=1.0, shape=(2, 3)
    )
    scan = clra.Scan(np.ones((3, 2, 3), np.float32), geometry, name="näme.nxs")
    return provenance(
        command="clra reconstruct 'näme.nxs' -o v.h5",
        scan=scan,
        alignment=AlignmentResult.from_motion(clra.Motion.identity(3)),
        method="osem-tr",
        options=OrderedSubsets(passes=2, initial=np.zeros(GRID.shape)),
        grid=GRID,
    )


def test_all_there_is_to_tell(told: dict[str, str]) -> None:
    assert told["clra_version"] == clra.__version__
    assert told["scan_checksum"].startswith("sha256:") and told["scan"] == "näme.nxs"
    assert told["alignment_checksum"].startswith("sha256:")
    options = json.loads(told["options"])
    assert options["passes"] == 2 and options["initial"] == "array"
    assert json.loads(told["grid"])["voxel_size"] == 0.5
    assert provenance() == {"clra_version": clra.__version__}


def test_alignments_are_told_apart_by_what_a_reconstruction_takes() -> None:
    one = AlignmentResult.from_motion(clra.Motion.identity(3))
    sums = {
        one.checksum_of_motion(),
        replace(one, valid_views=np.array([True, True, False])).checksum_of_motion(),
        replace(one, motion=one.motion.caused_by("source")).checksum_of_motion(),
        AlignmentResult.from_motion(
            clra.Motion(shift_u=[0, 0, 1e-9], shift_v=[0, 0, 0])
        ).checksum_of_motion(),
    }
    assert len(sums) == 4
    assert replace(one, schedule="1QR").checksum_of_motion() == one.checksum_of_motion()


def test_hdf5_volumes_tell(tmp_path: Path, told: dict[str, str]) -> None:
    volume = np.zeros(GRID.shape, np.float32)
    clra.write_volume(tmp_path / "v.h5", volume, GRID, provenance=told)
    with h5py.File(tmp_path / "v.h5") as file:
        assert dict(file.attrs) == told
    clra.write_volume(tmp_path / "v.h5", volume, GRID)
    with h5py.File(tmp_path / "v.h5") as file:
        assert dict(file.attrs) == {"clra_version": clra.__version__}


@pytest.mark.parametrize("big", [False, True])
def test_tiff_volumes_tell(
    tmp_path: Path, told: dict[str, str], big: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    if big:
        monkeypatch.setattr(tiff_files, "_PLAIN_TIFF", 0)
    path = tmp_path / "v.tif"
    clra.write_volume(path, np.zeros(GRID.shape, np.float32), GRID, provenance=told)
    with tifffile.TiffFile(path) as file:
        assert file.pages.first.tags["Software"].value == f"clra {clra.__version__}"
        description = file.ome_metadata if big else file.imagej_metadata["Info"]
    assert description is not None
    line = description.partition("clra provenance: ")[2].splitlines()[0]
    line = line.replace("&quot;", '"').replace("&apos;", "'")
    assert json.loads(line) == told
    assert clra.io.volumes.volume_files.read_volume(path)[1] == GRID


def test_scans_tell(tmp_path: Path, told: dict[str, str]) -> None:
    geometry = clra.circular(
        3, source_to_axis=5, source_to_detector=50, pixel_size=1.0, shape=(2, 3)
    )
    scan = clra.Scan(np.ones((3, 2, 3), np.float32), geometry)
    clra.write_scan(tmp_path / "s.nxs", scan, provenance=told)
    with h5py.File(tmp_path / "s.nxs") as file:
        assert told.items() <= dict(file.attrs).items()
