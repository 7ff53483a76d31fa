"""How the projectors are called: views in parts, slabs, orders of axes, offsets, and refusals."""

from dataclasses import replace

import numpy as np
import pyopencl as cl
import pyopencl.array as cl_array
import pytest
from projector_cases import (
    DETECTOR,
    GEOMETRIES,
    GRID,
    assert_close,
    back,
    forms,
    forward,
    numbers,
    off_centre,
    on_device,
    perturbed,
)

from clra import VolumeGrid, circular
from clra.ops.projection import cpu_forms, gpu_forms, layout
from clra.ops.projection.projector import BackProjector, ForwardProjector
from clra.ops.runtime.profile import forced


def test_set_geometry_is_a_new_operator(queue):
    before, after = GEOMETRIES["circle"], off_centre(GEOMETRIES["circle"])
    tilted = perturbed(before, 0.5)
    volume, projections = numbers(*GRID.shape), numbers(before.views, *before.shape)
    out = cl_array.empty(queue, projections.shape, np.float32)
    operator = ForwardProjector(queue.context, before, GRID)
    backward = BackProjector(queue.context, before, GRID)
    image = cl_array.empty(queue, GRID.shape, np.float32)
    for geometry in after, tilted, before:
        operator.set_geometry(geometry)
        operator(queue, out, on_device(queue, volume))
        assert np.array_equal(out.get(), forward(queue, geometry, GRID, volume))
        backward.set_geometry(geometry)
        backward(queue, image, on_device(queue, projections))
        assert np.array_equal(image.get(), back(queue, geometry, GRID, projections))


@forms
def test_a_view_that_misses_the_volume_gives_nothing(queue, form):
    geometry = circular(1, **DETECTOR)
    grid = VolumeGrid(shape=(9, 8, 7), voxel_size=1.0, centre=(0.0, 0.0, 60.0))
    assert not forward(queue, geometry, grid, numbers(*grid.shape)).any()
    projections = numbers(1, *geometry.shape)
    assert not back(queue, geometry, grid, projections).any()
    assert not back(queue, geometry, grid, projections, matched=True).any()


@pytest.mark.parametrize("name", ["helix", "space-filling", "v down", "tilted"])
def test_heights_are_what_a_view_sees(queue, name):
    """No voxel beyond them gets anything; of axial views those at the ends do."""
    geometry = GEOMETRIES[name]
    ones = on_device(queue, np.ones((1, *geometry.shape)))
    for view, (bottom, top) in enumerate(layout.heights(geometry, GRID)):
        volume = cl_array.empty(queue, GRID.shape, np.float32)
        one = geometry.subset(slice(view, view + 1))
        BackProjector(queue.context, one, GRID)(queue, volume, ones).wait()
        seen = np.flatnonzero(volume.get().any(axis=(1, 2)))
        assert not len(seen) or (bottom <= seen[0] and seen[-1] < top)
        if geometry.axial:
            assert len(seen) >= top - bottom - 3


@pytest.mark.parametrize("small", [False, True], ids=["at once", "in parts"])
@forms
def test_views_may_come_in_chunks(queue, monkeypatch, request, form, small):
    if small:  # scratch for two views, parts of two planes
        monkeypatch.setattr(layout, "_LEAST_VIEWS", 2)
        monkeypatch.setattr(cpu_forms, "_PART_BYTES", 0)
        monkeypatch.setattr(gpu_forms, "_RUN", 2)
        monkeypatch.setattr(gpu_forms, "_MOST_WORK", 5 * np.prod(GRID.shape))
        monkeypatch.setattr(cpu_forms, "_LEAST_PLANES", 2)
        tight = forced(replace(form, projector_bytes=0))
        tight.__enter__()
        request.addfinalizer(lambda: tight.__exit__(None, None, None))
    geometry = GEOMETRIES["space-filling"]
    volume, projections = numbers(*GRID.shape), numbers(geometry.views, *geometry.shape)
    chunks = [slice(0, 3), slice(3, None)]
    operator = ForwardProjector(queue.context, geometry, GRID)
    for chunk in chunks:
        out = cl_array.empty(queue, projections[chunk].shape, np.float32)
        operator(queue, out, on_device(queue, volume), views=chunk)
        assert_close(out.get(), forward(queue, geometry, GRID, volume)[chunk])
    for matched in False, True:
        options = {"matched": matched}
        operator = BackProjector(queue.context, geometry, GRID, **options)
        out = on_device(queue, np.full(GRID.shape, np.nan))
        for chunk in chunks:
            part = on_device(queue, projections[chunk])
            operator(queue, out, part, views=chunk, accumulate=chunk is not chunks[0])
        assert_close(out.get(), back(queue, geometry, GRID, projections, **options))


@forms
def test_accumulating_adds(queue, form):
    geometry = GEOMETRIES["circle"]
    volume, projections = numbers(*GRID.shape), numbers(geometry.views, *geometry.shape)
    out = on_device(queue, projections)
    operator = ForwardProjector(queue.context, geometry, GRID)
    operator(queue, out, on_device(queue, volume), accumulate=True)
    assert_close(out.get(), projections + forward(queue, geometry, GRID, volume))
    for order, axes in ("zyx", (0, 1, 2)), ("yxz", (1, 2, 0)):
        for matched in False, True:
            operator = BackProjector(
                queue.context, geometry, GRID, matched=matched, volume_order=order
            )
            out = on_device(queue, volume.transpose(axes))
            operator(queue, out, on_device(queue, projections), accumulate=True)
            added = back(queue, geometry, GRID, projections, matched=matched)
            assert_close(out.get(), (volume + added).transpose(axes))


def test_slabs_of_a_volume_add_up(queue):
    geometry, volume = GEOMETRIES["helix"], numbers(*GRID.shape)
    expected = forward(queue, geometry, GRID, volume)
    parts = [
        forward(queue, geometry, GRID.slab(start, stop), volume[start:stop])
        for start, stop in [(0, 5), (5, 17), (17, 19)]
    ]
    assert_close(sum(parts), expected)


@forms
def test_the_devices_own_order(queue, form):
    geometry = GEOMETRIES["off centre"]
    volume, projections = numbers(*GRID.shape), numbers(geometry.views, *geometry.shape)
    columns = on_device(queue, volume.transpose(1, 2, 0))
    out = cl_array.empty(queue, projections.shape, np.float32)
    ForwardProjector(queue.context, geometry, GRID, volume_order="yxz")(queue, out, columns)
    assert np.array_equal(out.get(), forward(queue, geometry, GRID, volume))
    for matched in False, True:
        BackProjector(queue.context, geometry, GRID, matched=matched, volume_order="yxz")(
            queue, columns, on_device(queue, projections)
        )
        expected = back(queue, geometry, GRID, projections, matched=matched)
        assert np.array_equal(columns.get(), expected.transpose(1, 2, 0))


def test_arrays_may_begin_within_their_buffers(queue):
    geometry = GEOMETRIES["off centre"]
    volume, projections = numbers(3, *GRID.shape), numbers(9, *geometry.shape)
    volumes, radiographs = on_device(queue, volume), on_device(queue, projections)
    ForwardProjector(queue.context, geometry, GRID)(queue, radiographs[2:8], volumes[1])
    expected = projections.copy()
    expected[2:8] = forward(queue, geometry, GRID, volume[1])
    assert np.array_equal(radiographs.get(), expected)
    BackProjector(queue.context, geometry, GRID)(queue, volumes[1], radiographs[2:8])
    volume[1] = back(queue, geometry, GRID, expected[2:8])
    assert np.array_equal(volumes.get(), volume)


def test_a_queue_may_be_out_of_order(context, queue, unordered):
    geometry = GEOMETRIES["helix"]
    volume, projections = numbers(*GRID.shape), numbers(geometry.views, *geometry.shape)
    device = on_device(queue, volume)
    out = cl_array.empty(queue, projections.shape, np.float32)
    one = ForwardProjector(context, geometry, GRID)
    other = BackProjector(context, geometry, GRID, matched=True)
    expected = volume
    event = None
    for _ in range(4):
        event = one(unordered, out, device, wait_for=event and [event])
        event = other(unordered, device, out, wait_for=[event])
        projected = forward(queue, geometry, GRID, expected)
        expected = back(queue, geometry, GRID, projected, matched=True)
    event.wait()
    assert np.array_equal(device.get(queue=queue), expected.astype(np.float32))


def test_the_same_input_gives_the_same_bits(queue):
    geometry = GEOMETRIES["little tilt"]
    projections = numbers(geometry.views, *geometry.shape)
    first, second = (back(queue, geometry, GRID, projections, matched=True) for _ in range(2))
    assert np.array_equal(first, second)


def test_what_is_not_an_array_of_the_device_is_refused(queue):
    geometry = GEOMETRIES["circle"]
    operator = ForwardProjector(queue.context, geometry, GRID)
    out = cl_array.empty(queue, (geometry.views, *geometry.shape), np.float32)
    volume = numbers(*GRID.shape)
    with pytest.raises(TypeError, match=r"volume: found ndarray, expected a pyopencl.array.Array"):
        operator(queue, out, volume)
    with pytest.raises(ValueError, match=r"projections: found float64, expected float32"):
        BackProjector(queue.context, geometry, GRID)(
            queue, on_device(queue, volume), out.astype(np.float64)
        )
    with pytest.raises(ValueError, match=r"volume: found shape \(11, 19, 14\), expected \(19, 1"):
        operator(queue, out, on_device(queue, volume.transpose(1, 0, 2)))
    with pytest.raises(ValueError, match=r"projections_out: found shape .* expected \(3, 15, 19\)"):
        operator(queue, out, on_device(queue, volume), views=slice(1, 4))


def test_another_context_is_refused(queue):
    geometry = GEOMETRIES["circle"]
    other = cl.Context([queue.device])  # Intel's queues do not keep their context
    foreign = cl.CommandQueue(other)
    operator = ForwardProjector(queue.context, geometry, GRID)
    out = cl_array.empty(queue, (geometry.views, *geometry.shape), np.float32)
    volume = on_device(queue, numbers(*GRID.shape))
    with pytest.raises(ValueError, match=r"queue: its context .* is not the operator's"):
        operator(foreign, out, volume)
    with pytest.raises(ValueError, match=r"volume: its context .* is not the operator's"):
        operator(queue, out, on_device(foreign, numbers(*GRID.shape)))


def test_geometries_that_do_not_fit_are_refused(queue):
    geometry = GEOMETRIES["circle"]
    with pytest.raises(ValueError, match="volume_order: found 'xyz', expected 'zyx' or 'yxz'"):
        BackProjector(queue.context, geometry, GRID, volume_order="xyz")
    with pytest.raises(ValueError, match="grid: it reaches behind the source of view 1"):
        ForwardProjector(queue.context, geometry, VolumeGrid(shape=(3, 99, 99), voxel_size=1.5))
    operator = ForwardProjector(queue.context, geometry, GRID)
    with pytest.raises(ValueError, match=r"geometry: found \(3, 15, 19\), expected \(8, 15, 19\)"):
        operator.set_geometry(geometry.subset(slice(3)))
    out = cl_array.empty(queue, (4, *geometry.shape), np.float32)
    with pytest.raises(ValueError, match=r"views: found slice.*, expected successive ones of 8"):
        operator(queue, out, on_device(queue, numbers(*GRID.shape)), views=slice(0, 8, 2))
