"""Derivatives by a rigid motion against finite differences of closed forms, and their products."""

import numpy as np
import pyopencl.array as cl_array
import pytest
from geometries import upside_down
from projector_cases import off_centre, perturbed

from clra.errors import InputError
from clra.model.geometry import ConeBeamGeometry
from clra.model.rigid.rigid_motion import RigidMotion
from clra.model.trajectory import circular, helix
from clra.ops.images.bandpass import Bandpass
from clra.ops.registration.rigid_registration import PRODUCTS, RigidRegistration, rigid_table
from clra.ops.registration.windows import registration_window

# Blobs of some pixels: centre, sigma [mm], attenuation.
BLOBS = (((1.0, -2.0, 0.7), 2.0, 1.0), ((-3.0, 1.0, -1.5), 1.6, 0.6), ((2.0, 3.0, 1.0), 1.8, 0.8))
DERIVATIVE = 0.02  # of the norm of each derivative
DETECTOR = {
    "source_to_axis": 60.0,
    "source_to_detector": 100.0,
    "pixel_size": 0.9,
    "shape": (31, 37),
}


def perpendicular(geometry: ConeBeamGeometry) -> ConeBeamGeometry:
    """The same with v turned until it is perpendicular to u."""
    u = geometry.u / np.linalg.norm(geometry.u, axis=1, keepdims=True)
    v = geometry.v - np.sum(geometry.v * u, axis=1, keepdims=True) * u
    return ConeBeamGeometry(
        source=geometry.source, detector=geometry.detector, u=geometry.u, v=v, shape=geometry.shape
    )


GEOMETRIES = {
    "circle": circular(4, start=0.2, **DETECTOR),
    "helix": helix(4, angle_step=0.9, z_step=0.8, **DETECTOR),
    "off centre": off_centre(circular(4, start=0.3, **DETECTOR)),
    "v down": upside_down(circular(3, start=0.4, **DETECTOR)),
    "tilted": perpendicular(perturbed(helix(4, angle_step=0.9, z_step=0.8, **DETECTOR), 3.0)),
}


def integrals(geometry: ConeBeamGeometry, samples: int = 1500) -> tuple[np.ndarray, np.ndarray]:
    """Line integrals of the blobs, and of the blobs over the depth, by quadrature in float64."""
    column = np.arange(geometry.columns) - (geometry.columns - 1) / 2
    row = np.arange(geometry.rows) - (geometry.rows - 1) / 2
    source, detector, u, v = (a[:, None, None] for a in np.split(geometry.to_astra(), 4, axis=1))
    ray = detector - source + row[:, None, None] * v + column[:, None] * u
    square = np.sum(ray**2, axis=-1)
    plain, over = np.zeros(square.shape), np.zeros(square.shape)
    offsets, step = np.linspace(-7, 7, samples, retstep=True)
    for centre, sigma, attenuation in BLOBS:
        nearest = np.sum(ray * (np.array(centre) - source), axis=-1) / square
        away = np.sum((source + nearest[..., None] * ray - centre) ** 2, axis=-1)
        peak = attenuation * np.exp(-0.5 * away / sigma**2)
        plain += peak * sigma * np.sqrt(2 * np.pi)
        for offset in offsets:
            depth = nearest + offset * sigma / np.sqrt(square)
            over += peak * np.exp(-0.5 * offset**2) * sigma * step / depth
    return plain, over


def images(queue, geometry, measured, simulated, over) -> np.ndarray:
    """Derivatives, simulated radiograph and difference of each view."""
    operator = RigidRegistration(queue.context, geometry.shape, views=geometry.views)
    given = [cl_array.to_device(queue, a.astype(np.float32)) for a in (measured, simulated, over)]
    table = cl_array.to_device(queue, rigid_table(geometry))
    rows, columns = geometry.shape
    operator._derivatives(
        queue,
        (columns, rows, geometry.views),
        *(operator._images, *given, table, columns, rows, geometry.views),
    ).wait()
    return operator._images.with_queue(queue).get()


@pytest.mark.parametrize("geometry", GEOMETRIES.values(), ids=GEOMETRIES)
def test_derivatives_against_finite_differences_of_closed_forms(queue, geometry):
    simulated, over = integrals(geometry)
    found = images(queue, geometry, simulated, simulated, over)
    scale = np.linalg.norm(geometry.u[0]) * (
        geometry.source_to_axis[0] / geometry.source_to_detector[0]
    )
    inside = registration_window(geometry.shape, 0.12, 0.7) > 0
    for k in range(6):
        step = 0.2 * scale if k < 3 else 0.01
        table = np.zeros((geometry.views, 6))
        table[:, k] = step
        ahead, behind = (
            integrals(geometry.with_motion(RigidMotion.of(geometry, sign * table)), samples=3)[0]
            for sign in (1, -1)
        )
        expected = (ahead - behind) / (2 * step)
        error = np.linalg.norm((found[:, k] - expected)[:, inside])
        assert error < DERIVATIVE * np.linalg.norm(expected[:, inside]), k


def test_products_against_float64(queue):
    geometry = GEOMETRIES["helix"]
    simulated, over = integrals(geometry)
    measured = simulated + np.random.default_rng(0).normal(size=simulated.shape)
    operator = RigidRegistration(queue.context, geometry.shape, views=4)
    given = [cl_array.to_device(queue, a.astype(np.float32)) for a in (measured, simulated, over)]
    table = cl_array.to_device(queue, rigid_table(geometry))
    totals = cl_array.empty(queue, (4, operator.blocks, PRODUCTS), np.float32)
    operator(queue, totals, *given, table).wait()
    every = images(queue, geometry, measured, simulated, over)
    band = Bandpass(queue.context, geometry.shape, views=32, low_pass=0.7, high_pass=8.0)
    banded = cl_array.empty(queue, (32, *geometry.shape), np.float32)
    flat = np.ascontiguousarray(every.reshape(32, *geometry.shape))
    band(queue, banded, cl_array.to_device(queue, flat)).wait()
    filtered = banded.get().reshape(every.shape).astype(np.float64)
    weights = registration_window(geometry.shape, 0.12, 0.7)
    gram = np.einsum("nirc,njrc,rc->nij", filtered, filtered, weights)
    expected = np.stack([one[np.triu_indices(8)] for one in gram])
    size = np.sqrt(np.einsum("nii->ni", gram))
    scale = np.stack([np.outer(one, one)[np.triu_indices(8)] for one in size])
    assert operator.blocks > 1
    assert np.abs((totals.get().sum(axis=1) - expected) / scale).max() < 1e-5


def test_bad_arrays_are_refused(queue):
    operator = RigidRegistration(queue.context, (31, 37), views=2)
    images = cl_array.zeros(queue, (3, 31, 37), np.float32)
    totals = cl_array.zeros(queue, (3, operator.blocks, PRODUCTS), np.float32)
    views = cl_array.zeros(queue, (3, 80), np.float32)
    with pytest.raises(InputError, match="found 3 views, expected 1 to 2"):
        operator(queue, totals, images, images, images, views)
    with pytest.raises(InputError, match="views"):
        operator(queue, totals[:2], images[:2], images[:2], images[:2], views)
