"""Every device operation with a small odd example, for tests that go through all of them."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyopencl as cl
import pyopencl.array as cl_array

import clra
from clra.model.helix.helix import Helix
from clra.model.phantoms.ellipsoids import porous
from clra.ops.filtering.fft import RealFFT
from clra.ops.filtering.katsevich_filter import KatsevichFilter
from clra.ops.filtering.ramp import RampFilter
from clra.ops.images.bandpass import Bandpass
from clra.ops.images.pyramid import Prolong3D, Restrict2D, Restrict3D
from clra.ops.images.warp import Warp
from clra.ops.projection.coverage import Coverage
from clra.ops.projection.moment_projector import MomentProjector
from clra.ops.projection.pi_backprojector import PiBackProjector
from clra.ops.registration.gauss_newton import Registration
from clra.ops.registration.phase_correlation import PhaseCorrelation
from clra.ops.registration.rigid_registration import RigidRegistration, rigid_table
from clra.ops.statistics.poisson import RayStatistics, VolumeStep
from clra.ops.streaming.multigrid import Residual

FORMS = 2e-5  # of the largest value: forms of a kernel for CPU and GPU differ by roundings
REGISTERED = 1e-3  # likewise, for estimates that iterate to this

VIEWS, ROWS, COLUMNS = 5, 19, 23
GRID = clra.VolumeGrid(shape=(7, 11, 9), voxel_size=0.2)
GEOMETRY = clra.circular(
    VIEWS, source_to_axis=25.0, source_to_detector=50.0, pixel_size=0.3, shape=(ROWS, COLUMNS)
)
TILTED = clra.ConeBeamGeometry(
    source=GEOMETRY.source,
    detector=GEOMETRY.detector,
    u=GEOMETRY.u,
    v=GEOMETRY.v + 0.05 * GEOMETRY.u,
    shape=GEOMETRY.shape,
)
# Some rays advance fastest along z.
STEEP = clra.circular(
    VIEWS, source_to_axis=25.0, source_to_detector=50.0, pixel_size=7.0, shape=(ROWS, COLUMNS)
)
HELIX = Helix(
    views=13,
    start=0.4,
    angle_step=0.7,
    z=-1.2,
    z_step=0.2,
    source_to_axis=20.0,
    source_to_detector=50.0,
    principal=(11.2, 9.3),
    pitch_u=0.5,
    pitch_v=0.6,
    shape=(ROWS, COLUMNS),
)
RADIUS = 1.9
FILTERED = HELIX.between().cropped(*HELIX.window_rows(RADIUS))
IMAGES = (VIEWS, ROWS, COLUMNS)
RANDOM = np.random.default_rng(7)


def values(*shape: int) -> np.ndarray:
    return RANDOM.uniform(0.1, 1, shape).astype(np.float32)


def radiographs() -> np.ndarray:
    """Blobs that registration can hold on to."""
    spectrum = np.fft.rfft2(RANDOM.normal(size=IMAGES))
    v, u = np.fft.fftfreq(ROWS)[:, None], np.fft.rfftfreq(COLUMNS)
    blurred = np.fft.irfft2(spectrum * np.exp(-60 * (u**2 + v**2)), s=(ROWS, COLUMNS))
    return blurred.astype(np.float32)


def normalised(coverage: Coverage) -> Callable[..., cl.Event]:
    """Coverage divides a volume in place; copied afterwards, it looks like the others."""

    def call(queue, out, volume, wait_for=None):
        counted = coverage.compute(queue, wait_for)
        divided = coverage.normalise(queue, volume, 2.0, wait_for=[counted])
        return cl.enqueue_copy(
            queue,
            out.base_data,
            volume.base_data,
            byte_count=volume.nbytes,
            src_offset=volume.offset,
            dst_offset=out.offset,
            wait_for=[divided],
        )

    return call


@dataclass(frozen=True)
class Case:
    """An operator with its result's shape and its inputs."""

    make: Callable[..., Any]
    out: tuple[int, ...]
    inputs: tuple[np.ndarray, ...]
    run: Callable[[Any], Callable[..., cl.Event]] = lambda operator: operator
    closeness: float = FORMS
    before: float = np.nan  # what the result's memory holds: overwritten, unless it is added to

    def empty(self, queue: cl.CommandQueue) -> cl_array.Array:
        """Memory for the result."""
        return cl_array.to_device(queue, np.full(self.out, self.before, np.float32))


MOTION = np.array([[0.3, -0.4, 1.01]] * VIEWS, np.float32)
PAIR = (radiographs(), radiographs())
PAIR[1][:] += 4 * np.roll(PAIR[0], (0, -1), (1, 2))
PHOTONS = RANDOM.uniform(500, 1500, (ROWS, COLUMNS))
ROCK = porous(1.0, 1.2, seed=2, count=40).line_integrals(GEOMETRY)
CASES = {
    "forward": Case(
        lambda c, **a: clra.ForwardProjector(c, GEOMETRY, GRID, **a),
        IMAGES,
        (values(*GRID.shape),),
    ),
    "back": Case(
        lambda c, **a: clra.BackProjector(c, GEOMETRY, GRID, **a), GRID.shape, (values(*IMAGES),)
    ),
    "adjoint": Case(
        lambda c, **a: clra.BackProjector(c, GEOMETRY, GRID, matched=True, **a),
        GRID.shape,
        (values(*IMAGES),),
    ),
    "tilted forward": Case(
        lambda c, **a: clra.ForwardProjector(c, TILTED, GRID, **a), IMAGES, (values(*GRID.shape),)
    ),
    "tilted back": Case(
        lambda c, **a: clra.BackProjector(c, TILTED, GRID, **a), GRID.shape, (values(*IMAGES),)
    ),
    "tilted adjoint": Case(
        lambda c, **a: clra.BackProjector(c, TILTED, GRID, matched=True, **a),
        GRID.shape,
        (values(*IMAGES),),
    ),
    "steep adjoint": Case(
        lambda c, **a: clra.BackProjector(c, STEEP, GRID, matched=True, **a),
        GRID.shape,
        (values(*IMAGES),),
    ),
    "moments": Case(
        lambda c, **a: MomentProjector(c, GEOMETRY, GRID, **a),
        IMAGES,
        (values(*GRID.shape), values(*IMAGES)),
        lambda operator: (
            lambda queue, out, volume, over_depth, wait_for=None: operator(
                queue, out, over_depth, volume, wait_for=wait_for
            )
        ),
    ),
    "katsevich": Case(
        lambda c, **a: KatsevichFilter(c, HELIX, RADIUS, **a),
        (FILTERED.views, *FILTERED.shape),
        (values(HELIX.views, ROWS, COLUMNS),),
    ),
    "pi back": Case(
        lambda c, **a: PiBackProjector(c, [FILTERED], 0, GRID, RADIUS, **a),
        (*GRID.shape[1:], GRID.shape[0]),
        (values(FILTERED.views, *FILTERED.shape),),
        before=0.0,
    ),
    "ramp": Case(lambda c, **a: RampFilter(c, GEOMETRY, **a), IMAGES, (values(*IMAGES),)),
    "coverage": Case(
        lambda c, **a: Coverage(c, GEOMETRY, GRID, np.ones(ROWS), **a),
        GRID.shape,
        (values(*GRID.shape),),
        normalised,
    ),
    "transform": Case(
        lambda c, **a: RealFFT(c, IMAGES, **a),
        IMAGES,
        (values(*IMAGES), values(ROWS, COLUMNS // 2 + 1)),
        lambda operator: operator.apply,
    ),
    "warp": Case(lambda c, **a: Warp(c, IMAGES[1:], **a), IMAGES, (values(*IMAGES), MOTION)),
    "restrict images": Case(Restrict2D, (VIEWS, ROWS // 2, COLUMNS // 2), (values(*IMAGES),)),
    "restrict": Case(Restrict3D, (2, ROWS // 2, COLUMNS // 2), (values(*IMAGES),)),
    "prolong": Case(Prolong3D, IMAGES, (values(2, ROWS // 2, COLUMNS // 2),)),
    "band-pass": Case(
        lambda c, **a: Bandpass(c, IMAGES[1:], views=VIEWS, high_pass=4.0, **a),
        IMAGES,
        (values(*IMAGES),),
    ),
    "phase correlation": Case(
        lambda c, **a: PhaseCorrelation(c, IMAGES[1:], views=3, **a),
        (VIEWS, 2),
        PAIR,
        closeness=REGISTERED,
    ),
    "registration": Case(
        lambda c, **a: Registration(c, IMAGES[1:], views=3, high_pass=4.0, **a),
        (VIEWS, 10),
        PAIR,
        closeness=REGISTERED,
    ),
    "rigid registration": Case(
        lambda c, **a: RigidRegistration(c, IMAGES[1:], views=VIEWS, high_pass=4.0, **a),
        (VIEWS, 3, 36),
        (*PAIR, values(*IMAGES), rigid_table(GEOMETRY)),
        closeness=REGISTERED,
    ),
    "residual": Case(
        lambda c: Residual(c, np.arange(ROWS * COLUMNS).reshape(ROWS, COLUMNS) % 7 > 0),
        IMAGES,
        (values(*IMAGES), values(*IMAGES), MOTION),
    ),
    **{
        f"likelihood, {name}": Case(
            lambda c: RayStatistics(c, PHOTONS, 3.0),
            IMAGES,
            tuple(values(*IMAGES) for _ in range(count)),
            lambda operator, name=name: getattr(operator, name),
        )
        for name, count in (("gradient", 2), ("curvature", 2), ("optimal_curvature", 3))
    },
    "likelihood, balance": Case(
        lambda c: RayStatistics(c, PHOTONS, 3.0),
        IMAGES,
        (values(*IMAGES), values(*IMAGES)),
        lambda operator: operator.balance,
        before=0.4,
    ),
    "add step": Case(
        VolumeStep,
        GRID.shape,
        (values(*GRID.shape), values(*GRID.shape)),
        lambda operator: (
            lambda queue, out, numerator, denominator, wait_for=None: operator.add(
                queue, out, numerator, denominator, 0.5, 0.2, wait_for
            )
        ),
        before=0.4,
    ),
    "multiply step": Case(
        VolumeStep,
        GRID.shape,
        (values(*GRID.shape), values(*GRID.shape)),
        lambda operator: operator.multiply,
        before=0.4,
    ),
    "alignment step": Case(
        lambda c, **a: clra.AlignmentStep(c, GEOMETRY, GRID, high_pass=4.0, **a),
        (VIEWS, 10),
        (values(*GRID.shape), ROCK),
        closeness=REGISTERED,
    ),
}
# What takes memory between its kernels, or may take it, and so an allocator.
WITH_SCRATCH = (
    "forward",
    "back",
    "adjoint",
    "tilted forward",
    "tilted back",
    "tilted adjoint",
    "steep adjoint",
    "moments",
    "katsevich",
    "pi back",
    "ramp",
    "coverage",
    "warp",
    "band-pass",
    "phase correlation",
    "registration",
    "alignment step",
)


def result(case: Case, operator: Any, queue: cl.CommandQueue) -> np.ndarray:
    """Result of one call with arrays of the queue's context."""
    inputs = [cl_array.to_device(queue, host) for host in case.inputs]
    out = case.empty(queue)
    event = case.run(operator)(queue, out, *inputs)
    assert event.command_queue == queue
    event.wait()
    return out.get()
