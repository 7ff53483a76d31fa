from pathlib import Path

import h5py
import numpy as np
import pytest
import tifffile

from clra.errors import InputError, OutputError
from clra.io.volumes import tiff
from clra.io.volumes.volume_files import open_volume, read_volume, write_volume
from clra.model.grid import VolumeGrid

GRID = VolumeGrid(shape=(5, 7, 9), voxel_size=0.0123456789, centre=(0.5, -1.25, 1 / 3))


@pytest.fixture
def volume() -> np.ndarray:
    return np.random.default_rng(0).normal(size=GRID.shape).astype(np.float32)


@pytest.fixture(params=["vol.h5", "vol.tif", "big.tif"])
def path(request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    if request.param == "big.tif":
        monkeypatch.setattr(tiff, "_PLAIN_TIFF", 0)
    return tmp_path / request.param


def test_volume_and_grid_survive(path: Path, volume: np.ndarray) -> None:
    told = []
    write_volume(path, volume, GRID, progress=told.append)
    read, grid = read_volume(path)
    np.testing.assert_array_equal(read, volume)
    assert grid == GRID
    assert (told[-1].done, told[-1].total) == (5, 5)
    part, slab = read_volume(path, 1, 4)
    np.testing.assert_array_equal(part, volume[1:4])
    assert slab == GRID.slab(1, 4)


def test_slabs_in_any_order(path: Path, volume: np.ndarray) -> None:
    with open_volume(path, GRID) as writer:
        writer.write(3, volume[3:4])
        writer.write(0, volume[0:2])
        with pytest.raises(ValueError, match=r"found shape \(2, 7, 9\) at 4, expected to fit"):
            writer.write(4, volume[:2])
    expected = volume.copy()
    expected[[2, 4]] = 0
    np.testing.assert_array_equal(read_volume(path)[0], expected)


def test_other_programs_read_the_voxels(path: Path, volume: np.ndarray) -> None:
    write_volume(path, volume, GRID, units="1/mm")
    if path.suffix == ".h5":
        with h5py.File(path) as file:
            attributes = file["volume"].attrs
            np.testing.assert_array_equal(file["volume"], volume)
            assert attributes["voxel_size"] == GRID.voxel_size
            assert attributes["units"] == "1/mm"
        return
    np.testing.assert_array_equal(tifffile.imread(path), volume)
    with tifffile.TiffFile(path) as tiff:
        across, per = tiff.pages.first.tags["XResolution"].value
        assert tiff.is_bigtiff == (path.name == "big.tif")
        if tiff.is_imagej:
            assert tiff.imagej_metadata["unit"] == "mm"
            assert tiff.imagej_metadata["spacing"] == pytest.approx(GRID.voxel_size)
            assert per / across == pytest.approx(GRID.voxel_size, rel=1e-6)
        else:
            assert f'PhysicalSizeZ="{GRID.voxel_size}"' in tiff.ome_metadata
            assert 10 * per / across == pytest.approx(GRID.voxel_size, rel=1e-6)


def test_interrupted_writing_leaves_nothing(path: Path, volume: np.ndarray) -> None:
    with pytest.raises(KeyboardInterrupt), open_volume(path, GRID) as writer:
        writer.write(0, volume[:1])
        raise KeyboardInterrupt
    assert not list(path.parent.iterdir())


def test_full_disk_while_writing(
    path: Path, volume: np.ndarray, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(OutputError, match="No space left on device; free some space"):
        with open_volume(path, GRID) as writer:
            writer.write(0, volume[:1])
            monkeypatch.setattr(writer, "_file", _FullDisk(writer._file))
            writer.write(1, volume[1:])
    assert not list(path.parent.iterdir())


class _FullDisk:
    """A file on a disk that is full."""

    def __init__(self, file) -> None:
        self.seek, self.close = file.seek, file.close

    def write(self, _: object) -> int:
        raise OSError(28, "No space left on device")


def test_what_cannot_be_written(tmp_path: Path, volume: np.ndarray) -> None:
    with pytest.raises(OutputError, match=r"suffix '\.png', expected one of \.h5"):
        write_volume(tmp_path / "vol.png", volume, GRID)
    with pytest.raises(ValueError, match=r"found shape \(4, 7, 9\), expected \(5, 7, 9\)"):
        write_volume(tmp_path / "vol.h5", volume[1:], GRID)


def test_tiff_of_others(tmp_path: Path) -> None:
    stack = np.arange(3 * 4 * 5, dtype=np.uint16).reshape(3, 4, 5)
    path = tmp_path / "other.tif"
    tifffile.imwrite(path, stack, resolution=(2000, 2000), resolutionunit="CENTIMETER")
    voxels, grid = read_volume(path)
    np.testing.assert_array_equal(voxels, stack)
    assert grid == VolumeGrid(shape=(3, 4, 5), voxel_size=0.005)
    metadata = {"axes": "ZYX", "spacing": 7.5, "unit": "micron"}
    tifffile.imwrite(path, stack, imagej=True, resolution=(1 / 7.5, 1 / 7.5), metadata=metadata)
    assert read_volume(path)[1].voxel_size == pytest.approx(0.0075)
    metadata["spacing"] = 15.0
    tifffile.imwrite(path, stack, imagej=True, resolution=(1 / 7.5, 1 / 7.5), metadata=metadata)
    with pytest.raises(InputError, match=r"voxel: found .* mm, expected a cube"):
        read_volume(path)
    tifffile.imwrite(path, stack, compression="zlib", resolution=(10, 10), resolutionunit=3)
    np.testing.assert_array_equal(read_volume(path, 1, 2)[0], stack[1:2])


def test_what_is_no_volume(tmp_path: Path) -> None:
    path = tmp_path / "other.tif"
    with pytest.raises(InputError, match="no such file"):
        read_volume(path)
    path.write_text("not at all")
    with pytest.raises(InputError, match="cannot be read as TIFF"):
        read_volume(path)
    tifffile.imwrite(path, np.zeros((3, 4, 5), np.float32))
    with pytest.raises(InputError, match="expected a stack with the size of its voxels"):
        read_volume(path)
    with h5py.File(tmp_path / "other.h5", "w") as file:
        file["volume"] = np.zeros((3, 4, 5))
    with pytest.raises(InputError, match="voxel_size: found nothing"):
        read_volume(tmp_path / "other.h5")
