import numpy as np
import pytest
from scipy import ndimage

from clra.ops.images.blur import Blur, gaussian_taps
from clra.ops.runtime import lines
from clra.ops.runtime.buffers import to_device
from clra.ops.runtime.lines import MARGIN, line_stride, lined
from clra.ops.runtime.profile import CPU, GPU

ROUNDING = 2e-6  # of values around 1


@pytest.mark.parametrize("form", [CPU, GPU], ids=["cpu", "gpu"], indirect=True)
@pytest.mark.parametrize(("shape", "sigma"), [((23, 37), 2.0), ((40, 16), 3.5), ((5, 70), 0.7)])
def test_is_the_mean_of_what_lies_on_the_detector(context, queue, form, shape, sigma):
    images = np.random.default_rng(0).normal(size=(2, *shape))
    image = to_device(context, np.stack([lined(i) for i in images]))
    blank = np.zeros((2, shape[0], line_stride(shape[1])))
    out, between = to_device(context, blank), to_device(context, blank)
    Blur(context, shape, sigma)(queue, out, image, between, 2)
    taps = gaussian_taps(sigma)
    parts = np.ones(shape)
    for axis in (0, 1):
        images = ndimage.correlate1d(images, taps, axis + 1, mode="constant")
        parts = ndimage.correlate1d(parts, taps, axis, mode="constant")
    found = out.get(queue)
    inner = found[:, :, MARGIN : MARGIN + shape[1]]
    np.testing.assert_allclose(inner, images / parts, rtol=0, atol=ROUNDING)
    found[:, :, MARGIN : MARGIN + shape[1]] = 0
    assert not found.any()


def test_taps_have_their_variance():
    taps = gaussian_taps(3.0)
    k = np.arange(taps.size) - taps.size // 2
    assert taps.sum() == pytest.approx(1)
    assert taps @ k**2 == pytest.approx(9, rel=0.02)


def test_lines_leave_room():
    for columns in (1, 16, 17, 100):
        stride = lines.line_stride(columns)
        assert stride % 16 == 0 and stride >= columns + 2 * MARGIN
