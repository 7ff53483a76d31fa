"""Volumes as programs nobody here wrote read them."""

import json

import h5py
import numpy as np
import pytest
import tifffile

from clra.errors import InputError, OutputError
from clra.io.volumes.integer_limits import Limits
from clra.io.volumes.volume_files import open_volume, read_volume, write_volume
from clra.model.grid import VolumeGrid

GRID = VolumeGrid(shape=(5, 7, 9), voxel_size=0.125, centre=(0.5, -0.25, 2.0))
FIRST = [axis[0] for axis in GRID.coordinates()]  # x, y, z of the first voxel's middle
LARGE = VolumeGrid(shape=(37, 150, 270), voxel_size=0.125, centre=(0.5, -0.25, 2.0))
FORMATS = ["v.h5", "v.tif", "v.nrrd", "v.raw", "v.zarr"]


def _volume(grid=GRID, seed=0):
    return np.random.default_rng(seed).normal(size=grid.shape).astype(np.float32)


def _skip_without(name):
    if name.endswith(".zarr"):
        pytest.importorskip("zarr")


@pytest.mark.parametrize("name", FORMATS)
def test_what_is_written_is_read(tmp_path, name):
    _skip_without(name)
    volume = _volume()
    write_volume(tmp_path / name, volume, GRID)
    found, grid = read_volume(tmp_path / name)
    assert np.array_equal(found, volume)
    assert grid.shape == GRID.shape
    assert (grid.voxel_size, *grid.centre) == pytest.approx((0.125, *GRID.centre))
    part, slab = read_volume(tmp_path / name, 2, 4)
    assert np.array_equal(part, volume[2:4])
    assert slab.centre == pytest.approx(GRID.slab(2, 4).centre)
    assert {p.name for p in tmp_path.iterdir()} <= {name, "v.json"}


@pytest.mark.parametrize("name", FORMATS)
def test_slabs_may_come_in_any_order_and_others_are_zero(tmp_path, name):
    _skip_without(name)
    volume = _volume()
    with open_volume(tmp_path / name, GRID) as writer:
        writer.write(3, volume[3:5])
        writer.write(0, volume[:1])
    found, _ = read_volume(tmp_path / name)
    assert np.array_equal(found[[0, 3, 4]], volume[[0, 3, 4]])
    assert not found[1:3].any()


@pytest.mark.parametrize("name", FORMATS)
def test_a_failure_leaves_what_was_there(tmp_path, name):
    _skip_without(name)
    volume = _volume()
    write_volume(tmp_path / name, volume, GRID)
    with pytest.raises(KeyError), open_volume(tmp_path / name, GRID) as writer:
        writer.write(0, volume[:2] + 1)
        raise KeyError
    assert np.array_equal(read_volume(tmp_path / name)[0], volume)
    write_volume(tmp_path / name, volume + 1, GRID)
    assert np.array_equal(read_volume(tmp_path / name)[0], volume + 1)
    assert {p.name for p in tmp_path.iterdir()} <= {name, "v.json"}


@pytest.mark.parametrize("name", FORMATS)
@pytest.mark.parametrize("dtype", ["uint16", "uint8"])
def test_integers_tell_their_scale(tmp_path, name, dtype):
    _skip_without(name)
    volume = _volume()
    write_volume(tmp_path / name, volume, GRID, dtype=dtype, limits=Limits(-1, 1.5, False))
    found, _ = read_volume(tmp_path / name)
    step = 2.5 / np.iinfo(dtype).max
    assert np.abs(found - np.clip(volume, -1, 1.5)).max() < 0.51 * step


def test_percentiles_leave_out_what_is_outside_the_field_of_view(tmp_path):
    volume = _volume(LARGE)
    volume[:, :75] = 0
    write_volume(tmp_path / "v.h5", volume, LARGE, dtype="uint8", limits=Limits(5, 95))
    with h5py.File(tmp_path / "v.h5") as file:
        told = file["volume"].attrs
        low, high = told["add_offset"], told["add_offset"] + 255 * told["scale_factor"]
        assert file["volume"].dtype == np.uint8
    # Of a normal distribution.
    assert (low, high) == (pytest.approx(-1.645, abs=0.02), pytest.approx(1.645, abs=0.02))
    assert {p.name for p in tmp_path.iterdir()} == {"v.h5"}


def test_imagej_finds_voxel_and_values_in_a_tiff(tmp_path):
    volume = _volume()
    write_volume(tmp_path / "v.tif", volume, GRID, dtype="uint16", limits=Limits(-4, 4, False))
    with tifffile.TiffFile(tmp_path / "v.tif") as tiff:
        assert tiff.is_imagej
        told, tags = tiff.imagej_metadata, tiff.pages.first.tags
        assert (told["spacing"], told["unit"]) == (0.125, "mm")
        assert tags["XResolution"].value[0] / tags["XResolution"].value[1] == pytest.approx(8)
        # ImageJ's calibration function 0 is a straight line.
        assert told["cf"] == 0 and told["vunit"] == "1/mm"
        values = told["c0"] + told["c1"] * tiff.asarray().astype(np.float64)
    assert np.abs(values - volume).max() < 0.51 * 8 / 65535


def test_hdf5_may_be_compressed_in_chunks(tmp_path):
    volume = np.round(_volume(LARGE))
    write_volume(tmp_path / "v.h5", volume, LARGE, compression="gzip")
    with h5py.File(tmp_path / "v.h5") as file:
        dataset = file["volume"]
        assert dataset.chunks == (16, 128, 128)
        assert dataset.compression == "gzip"
        assert dataset.attrs["voxel_size"] == 0.125
        assert np.array_equal(dataset[()], volume)
    assert (tmp_path / "v.h5").stat().st_size < volume.nbytes / 4
    with pytest.raises(InputError, match=r"compression: found 'gzip' for .tif, expected gzip of"):
        write_volume(tmp_path / "v.tif", volume, LARGE, compression="gzip")


@pytest.mark.parametrize("dtype", ["float32", "uint16"])
def test_pynrrd_reads_nrrd(tmp_path, dtype):
    nrrd = pytest.importorskip("nrrd")
    volume = _volume()
    write_volume(tmp_path / "v.nrrd", volume, GRID, dtype=dtype, limits=Limits(-4, 4, False))
    found, header = nrrd.read(str(tmp_path / "v.nrrd"), index_order="C")
    scale, offset = float(header.get("scale_factor", 1)), float(header.get("add_offset", 0))
    assert np.abs(found * scale + offset - volume).max() < (1e-6 if dtype == "float32" else 7e-5)
    assert np.allclose(header["space directions"], 0.125 * np.eye(3))
    assert np.allclose(header["space origin"], FIRST)
    assert header["space units"] == ["mm"] * 3
    assert header["sample units"] == "1/mm"


def test_raw_is_what_its_json_says(tmp_path):
    volume = _volume()
    write_volume(tmp_path / "v.raw", volume, GRID)
    told = json.loads((tmp_path / "v.json").read_text())
    found = np.fromfile(tmp_path / told["file"], told["dtype"]).reshape(told["shape"])
    assert np.array_equal(found, volume)
    assert (told["voxel_size"], told["voxel_size_units"], told["units"]) == (0.125, "mm", "1/mm")


@pytest.mark.parametrize("dtype", ["float32", "uint16"])
def test_ome_zarr_models_validate_the_pyramid(tmp_path, dtype):
    zarr = pytest.importorskip("zarr")
    volume = _volume(LARGE)
    limits = Limits(-4, 4, False)
    write_volume(tmp_path / "v.zarr", volume, LARGE, dtype=dtype, limits=limits)
    root = zarr.open_group(tmp_path / "v.zarr", mode="r")
    described = root.attrs["ome"]["multiscales"][0]["datasets"]
    assert [root[d["path"]].shape for d in described] == [
        (37, 150, 270),
        (18, 75, 135),
        (9, 37, 67),
    ]
    for level, dataset in enumerate(described):
        scale, translation = dataset["coordinateTransformations"]
        size = 0.125 * 2**level
        assert scale["scale"] == [size] * 3
        # The middle of a coarse voxel is that of the eight it is the mean of.
        middle = np.array([axis[0] for axis in LARGE.coordinates()[::-1]]) + 0.5 * (size - 0.125)
        assert np.allclose(translation["translation"], middle)
    stored = root["0"][:36, :150, :270].astype(np.float64)
    mean = stored.reshape(18, 2, 75, 2, 135, 2).mean(axis=(1, 3, 5))
    assert np.abs(root["1"][()] - mean).max() <= (1e-6 if dtype == "float32" else 0.5)
    models = pytest.importorskip("ome_zarr_models.v05")
    image = models.Image.from_zarr(root)
    assert [axis.unit for axis in image.ome_attributes.multiscales[0].axes] == ["millimeter"] * 3


def test_zarr_folders_alone_are_replaced(tmp_path):
    pytest.importorskip("zarr")
    (tmp_path / "v.zarr").mkdir()
    (tmp_path / "v.zarr" / "precious").touch()
    with pytest.raises(OutputError, match="it is a folder"):
        write_volume(tmp_path / "v.zarr", _volume(), GRID)
    assert (tmp_path / "v.zarr" / "precious").exists()


@pytest.mark.parametrize(("low", "high", "percentiles"), [(2, 1, False), (5, 101, True)])
def test_limits_are_in_order(low, high, percentiles):
    with pytest.raises(InputError, match="limits: found"):
        Limits(low, high, percentiles)


def test_there_are_these_formats_and_types(tmp_path):
    with pytest.raises(OutputError, match=r"found suffix '.png', expected one of .h5, .hdf5"):
        write_volume(tmp_path / "v.png", _volume(), GRID)
    with pytest.raises(InputError, match="dtype: found 'int8', expected one of float32, uint16"):
        write_volume(tmp_path / "v.h5", _volume(), GRID, dtype="int8")
