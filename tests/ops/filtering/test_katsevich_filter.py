"""The filter against its formulas in float64: differences, interpolations and sums one by one."""

import dataclasses
import math

import numpy as np
import pyopencl as cl
import pyopencl.array as cl_array
import pytest

from clra.model.helix.helix import Helix
from clra.ops.filtering import katsevich_filter
from clra.ops.filtering.katsevich_filter import KatsevichFilter

RELATIVE = 2e-5  # of the largest magnitude: float32, and tabulated inverses
RADIUS = 4.0

BASE = Helix(
    views=9,
    start=0.4,
    angle_step=0.07,
    z=-1.0,
    z_step=0.11,
    source_to_axis=20.0,
    source_to_detector=50.0,
    principal=(17.2, 20.9),
    pitch_u=0.7,
    pitch_v=0.8,
    shape=(43, 37),
)
HELICES = [
    BASE,
    dataclasses.replace(BASE, z_step=-0.11),
    dataclasses.replace(BASE, angle_step=-0.07, pitch_v=-0.8),
    dataclasses.replace(BASE, pitch_u=-0.7, principal=(18.8, 22.1)),
    # a detector much taller than the window, and wider than the field of view
    dataclasses.replace(BASE, z_step=0.04, shape=(43, 46), principal=(17.0, 18.0)),
]


def image_of(helix: Helix) -> np.ndarray:
    """Smooth in every direction, so that views differ little; no sample outside the field."""
    view, row, column = np.indices((helix.views, *helix.shape))
    wave = np.sin(0.3 * column + 0.2 * view) * np.cos(0.25 * row - 0.1 * view)
    inside = np.abs(helix.tangent_u(column)) <= math.tan(helix.fan(RADIUS))
    return (inside * (wave + 0.01 * row * column / (1 + view))).astype(np.float32)


def filtered(helix: Helix, image: np.ndarray) -> np.ndarray:
    """Steps 1 to 4 for all rows of the window, (views - 1, rows, columns)."""
    p = image.astype(float)
    rows, columns = helix.shape
    scale = helix.source_to_detector
    u = helix.tangent_u(np.arange(columns - 1) + 0.5)
    v = (np.arange(rows - 1) + 0.5 - helix.principal[1])[:, None] * helix.pitch_v / scale

    def mean(a: np.ndarray, axis: int) -> np.ndarray:
        return 0.5 * (
            a.take(range(1, a.shape[axis]), axis) + a.take(range(a.shape[axis] - 1), axis)
        )

    along = mean(mean(np.diff(p, axis=0), 1), 2) / helix.angle_step
    across = mean(mean(np.diff(p, axis=2), 0), 1) / (helix.pitch_u / scale)
    up = mean(mean(np.diff(p, axis=1), 0), 2) / (helix.pitch_v / scale)
    derivative = (along + (1 + u**2) * across + u * v * up) / np.sqrt(1 + u**2 + v**2)

    psi = katsevich_filter._angles(helix, RADIUS)
    out_column, at = np.arange(columns), np.arange(columns - 1)
    hilbert = 1 / (math.pi * (out_column[:, None] - at - 0.5)) * np.sign(helix.pitch_u)
    lines = np.empty((helix.views - 1, len(psi), columns))
    for n, angle in enumerate(psi):
        cotangent = angle / math.tan(angle) if angle else 1.0
        row = helix.row(helix.slope * (angle + cotangent * u)) - 0.5
        row = np.clip(row, 0, rows - 2)
        low = np.minimum(row.astype(int), rows - 3)
        line = derivative[:, low, at] * (1 - row + low) + derivative[:, low + 1, at] * (row - low)
        lines[:, n] = line @ hilbert.T

    first, last = helix.window_rows(RADIUS)
    out = np.empty((helix.views - 1, last - first, columns))
    for j, i in np.ndindex(last - first, columns):
        number = _line_of(helix, psi, (first + j - helix.principal[1]) * helix.pitch_v / scale, i)
        low = min(int(number), len(psi) - 2)
        out[:, j, i] = lines[:, low, i] + (number - low) * (lines[:, low + 1, i] - lines[:, low, i])
    return out * abs(helix.angle_step) / (2 * math.pi * scale)


def _line_of(helix: Helix, psi: np.ndarray, tangent_v: float, column: int) -> float:
    """Number of the line through a pixel, by bisection between the turning points about psi = 0."""
    t = float(helix.tangent_u(column))

    def value(angle: float) -> float:
        return angle + (angle / math.tan(angle) if angle else 1.0) * t

    fine = np.linspace(psi[0], psi[-1], 2001)
    rising = np.diff([value(angle) for angle in fine]) > 0
    middle = len(fine) // 2
    low = fine[np.flatnonzero(~rising[:middle]).max(initial=-1) + 1]
    high = fine[np.flatnonzero(~rising[middle:]).min(initial=middle) + middle]
    for _ in range(50):
        half = 0.5 * (low + high)
        low, high = (half, high) if value(half) < tangent_v / helix.slope else (low, half)
    return (low - psi[0]) / (psi[1] - psi[0])


@pytest.mark.parametrize("helix", HELICES)
def test_filter_is_the_formula(context, queue, helix):
    image = image_of(helix)
    operator = KatsevichFilter(context, helix, RADIUS)
    assert operator.helix.views == helix.views - 1
    out = cl_array.empty(queue, (helix.views - 1, *operator.helix.shape), np.float32)
    operator(queue, out, cl_array.to_device(queue, image)).wait()
    expected = filtered(helix, image)
    # Outside the field of view the line of least |psi| may be none that was filtered.
    inside = np.abs(helix.tangent_u(np.arange(helix.shape[1]))) <= math.tan(helix.fan(RADIUS))
    difference = (out.get() - expected)[:, :, inside]
    assert np.abs(difference).max() <= RELATIVE * np.abs(expected[:, :, inside]).max()


@pytest.mark.parametrize("kind", ["queue", "unordered"])
def test_chunks_and_offsets_change_nothing(context, kind, request, monkeypatch):
    queue = request.getfixturevalue(kind)
    image = image_of(BASE)
    whole = KatsevichFilter(context, BASE, RADIUS)
    shape = (BASE.views - 1, *whole.helix.shape)
    expected = cl_array.empty(queue, shape, np.float32)
    whole(queue, expected, cl_array.to_device(queue, image)).wait()
    # room for two views' lines, and for the transforms of a part of them
    monkeypatch.setattr(katsevich_filter, "_MOST_LINES", 31)
    room = 2 * 4 * whole.padded * whole._count + 100
    small = KatsevichFilter(context, BASE, RADIUS, scratch_limit=room)
    assert small.scratch_bytes < whole.scratch_bytes
    out = cl_array.zeros(queue, (shape[0] + 1, *shape[1:]), np.float32)[1:]
    measured = cl_array.to_device(queue, np.concatenate([image[:1], image]))[1:]
    queue.finish()
    event = small(queue, out[:5], measured[:6])
    small(queue, out[5:], measured[5:], wait_for=[event]).wait()
    np.testing.assert_allclose(
        out.get(), expected.get(), rtol=0, atol=1e-6 * np.abs(expected.get()).max()
    )


def test_reikna_gives_the_same(context, queue):
    image = cl_array.to_device(queue, image_of(BASE))
    volumes = []
    for backend in ("scipy", "reikna"):
        operator = KatsevichFilter(context, BASE, RADIUS, backend=backend)
        out = cl_array.empty(queue, (BASE.views - 1, *operator.helix.shape), np.float32)
        operator(queue, out, image).wait()
        volumes.append(out.get())
    assert np.abs(volumes[1] - volumes[0]).max() <= RELATIVE * np.abs(volumes[0]).max()


def test_what_is_refused(context, queue):
    operator = KatsevichFilter(context, BASE, RADIUS)
    measured = cl_array.zeros(queue, (3, *BASE.shape), np.float32)
    out = cl_array.zeros(queue, (2, *operator.helix.shape), np.float32)
    with pytest.raises(ValueError, match=r"projections: found shape .* with n at least 2"):
        operator(queue, out, measured[:1])
    with pytest.raises(ValueError, match="filtered_out: found shape"):
        operator(queue, measured, measured)
    with pytest.raises(TypeError, match="projections: found ndarray"):
        operator(queue, out, measured.get())
    theirs = cl.Context(context.devices)  # held: Intel's queues do not keep their context
    other = cl.CommandQueue(theirs)
    with pytest.raises(ValueError, match="queue: its context"):
        operator(other, out, measured)
