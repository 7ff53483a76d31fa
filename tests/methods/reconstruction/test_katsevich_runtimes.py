"""The same exact volume from every OpenCL runtime: skipped where there is only one.

tools/portability.py installs some and runs this.
"""

import math

import numpy as np
import pytest

import clra
from clra.model.grid import default_grid
from clra.model.phantoms.ellipsoids import porous

SAME = 1e-4  # of the largest attenuation


def test_every_device_gives_the_same():
    devices = [info.index for info in clra.devices()]
    if len(devices) == 1:
        pytest.skip("one device only")
    geometry = clra.double_helix(
        301,
        angle_step=math.radians(2.5),
        z_step=1.6 * 2.5 / 360,
        source_to_axis=3.0,
        source_to_detector=6.0,
        pixel_size=0.036,
        shape=(81, 121),
    )
    random = np.random.default_rng(2)
    motion = clra.Motion(
        shift_u=random.uniform(-2, 2, geometry.views),
        shift_v=random.uniform(-2, 2, geometry.views),
        magnification=random.uniform(0.99, 1.01, geometry.views),
    )
    images = porous(0.9, 4.0).line_integrals(geometry.with_motion(motion))
    scan = clra.Scan(images, geometry)
    grid = default_grid(geometry)
    assert grid.shape[0] % 8 and grid.shape[2] % 8
    volumes = [
        clra.reconstruct(scan, "katsevich", grid, motion=motion, device=device)
        for device in devices
    ]
    assert (volumes[0] != 0).mean() > 0.4
    for volume, device in zip(volumes[1:], devices[1:], strict=True):
        off = np.abs(volume - volumes[0]).max() / np.abs(volumes[0]).max()
        print(f"device {device}: differs by {off:.1e}")
        assert off < SAME
