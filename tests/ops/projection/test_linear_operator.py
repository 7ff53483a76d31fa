"""The projectors as a linear operator in other people's solvers."""

import numpy as np
import pytest
from scipy.sparse.linalg import lsqr

import clra
from clra.model.phantoms.ellipsoids import Ellipsoids

ADJOINT = 1e-6  # of the inner products, float32 sums
RESIDUAL = 0.02  # LSQR's after 20 iterations, of the projections; 0.013 was seen
ERROR = 0.15  # of the volume, likewise; a ball's rim is the last to converge

GRID = clra.VolumeGrid(shape=(9, 15, 13), voxel_size=0.2, centre=(0.05, 0.0, 0.1))
GEOMETRY = clra.circular(
    31, source_to_axis=25.0, source_to_detector=50.0, pixel_size=0.4, shape=(11, 19)
)


@pytest.fixture(params=["queue", "unordered"])
def operator(request):
    return clra.as_linear_operator(GEOMETRY, GRID, request.getfixturevalue(request.param))


@pytest.fixture(scope="module")
def ball() -> np.ndarray:
    ball = Ellipsoids(centres=[(0.1, -0.1, 0.1)], semi_axes=[(0.9, 1.0, 0.6)], attenuation=[0.5])
    return ball.volume(GRID)


def test_adjoint_is_the_transpose(operator):
    random = np.random.default_rng(3)
    x, y = (random.uniform(0, 1, n) for n in reversed(operator.shape))
    forward, back = np.vdot(operator @ x, y), np.vdot(x, operator.H @ y)
    assert forward == pytest.approx(back, rel=ADJOINT)


def test_lsqr_converges(operator, ball):
    projections = operator @ ball.ravel()
    solution, _, iterations, residual, *_ = lsqr(operator, projections, iter_lim=20)
    assert iterations == 20
    assert residual < RESIDUAL * np.linalg.norm(projections)
    assert np.linalg.norm(solution - ball.ravel()) < ERROR * np.linalg.norm(ball)


def test_pylops_takes_it(operator, ball):
    pylops = pytest.importorskip("pylops")
    projections = operator @ ball.ravel()
    wrapped = pylops.aslinearoperator(operator)
    start = np.zeros(operator.shape[1], np.float32)
    solution = pylops.optimization.basic.cgls(wrapped, projections, x0=start, niter=20)[0]
    assert np.linalg.norm(solution - ball.ravel()) < ERROR * np.linalg.norm(ball)


def test_pyproximal_takes_it(operator, ball):
    """Least squares with attenuations between 0 and 1, by accelerated proximal gradients."""
    pylops = pytest.importorskip("pylops")
    pyproximal = pytest.importorskip("pyproximal")
    largest = np.ones(operator.shape[1], np.float32)
    for _ in range(8):  # power iteration
        largest = operator.H @ (operator @ (largest / np.linalg.norm(largest)))
    misfit = pyproximal.L2(Op=pylops.aslinearoperator(operator), b=operator @ ball.ravel())
    solution = pyproximal.optimization.primal.ProximalGradient(
        misfit,
        pyproximal.Box(0, 1),
        x0=np.zeros(operator.shape[1], np.float32),
        tau=0.9 / np.linalg.norm(largest),
        niter=60,
        acceleration="fista",
    )
    assert solution.min() >= 0
    assert np.linalg.norm(solution - ball.ravel()) < ERROR * np.linalg.norm(ball)


class Tensor:
    """An array of another library, which gives no more than DLPack."""

    def __init__(self, values: np.ndarray) -> None:
        self._values = values

    def __dlpack__(self, **options):
        return self._values.__dlpack__(**options)

    def __dlpack_device__(self):
        return self._values.__dlpack_device__()


def test_buffers_and_dlpack_tensors_are_taken(operator, ball):
    expected = operator @ ball.ravel()
    buffer = memoryview(ball.tobytes()).cast("f")
    np.testing.assert_array_equal(operator.matvec(buffer), expected)
    np.testing.assert_array_equal(operator @ np.from_dlpack(Tensor(ball.ravel())), expected)


def test_a_matrix_of_volumes_is_projected_column_by_column(operator, ball):
    volumes = np.stack([ball.ravel(), 2 * ball.ravel()], axis=1)
    projections = operator @ volumes
    np.testing.assert_allclose(projections[:, 1], 2 * projections[:, 0], rtol=1e-6)


def test_wrong_length_is_refused(operator):
    with pytest.raises(ValueError, match="dimension mismatch"):
        operator @ np.zeros(operator.shape[1] + 1)
