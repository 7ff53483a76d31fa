"""Versions that a result depends on."""

from __future__ import annotations

import pyopencl as cl

import clra


def versions(device: cl.Device) -> dict[str, str]:
    """Return the versions of "clra", "pyopencl" and of the device's "driver".

    Parameters
    ----------
    device : cl.Device
        That the work runs on.
    """
    return {
        "clra": clra.__version__,
        "pyopencl": cl.VERSION_TEXT,
        "driver": f"{device.platform.name.strip()} {device.driver_version.strip()}",
    }
