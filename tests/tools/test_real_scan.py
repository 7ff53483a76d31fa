import numpy as np
import pytest
from scipy import ndimage

import clra


@pytest.fixture
def real_scan(tool):
    return tool("real_scan")


def _scan():
    shape = (21, 25)
    rows, columns = np.mgrid[:21, :25]
    image = np.exp(-((rows - 9) ** 2) / 8 - (columns - 13) ** 2 / 12)
    geometry = clra.circular(
        3, source_to_axis=1e4, source_to_detector=2e4, pixel_size=1.0, shape=shape, arc=np.pi
    )
    return clra.Scan(np.tile(image, (3, 1, 1)).astype(np.float32), geometry)


def test_images_move_as_the_motion_says(real_scan):
    scan = _scan()
    motion = clra.Motion(shift_u=[0, 2, -1.5], shift_v=[0, -1, 0.5], magnification=[1, 1, 1.05])
    images = real_scan.moved(scan, motion).read(0, 3)
    for image, u, v, m in zip(images, *motion.columns(), strict=True):
        # A feature at q is found at c + m (q - c) + shift.
        expected = 10 + m * (9 - 10) + v, 12 + m * (13 - 12) + u
        np.testing.assert_allclose(ndimage.center_of_mass(image), expected, atol=0.02)


def test_errors_are_free_of_what_a_parallel_beam_hides(real_scan):
    scan = _scan().subset([0, 1, 2])
    angle = np.arctan2(scan.geometry.source[:, 0], -scan.geometry.source[:, 1])
    truth = real_scan.injected(3, 5, smooth=True)
    found = clra.Motion(
        shift_u=truth.shift_u + 0.3 - np.cos(angle) + 2 * np.sin(angle),
        shift_v=truth.shift_v + np.array([0.7, 0.7, 1.0]),
    )
    u, v = real_scan.errors(scan, found, truth)
    np.testing.assert_allclose(u, 0, atol=1e-9)
    np.testing.assert_allclose(v, [-0.1, -0.1, 0.2], atol=1e-9)
