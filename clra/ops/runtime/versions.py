"""Versions that a result depends on."""

from __future__ import annotations

from importlib import metadata

import pyopencl as cl


def versions(device: cl.Device) -> dict[str, str]:
    """Return the versions of "clra", "pyopencl" and of the device's "driver".

    Parameters
    ----------
    device : cl.Device
        That the work runs on.
    """
    try:
        own = metadata.version("clra")
    except metadata.PackageNotFoundError:
        own = "unknown"  # run from a checkout that is not installed
    return {
        "clra": own,
        "pyopencl": cl.VERSION_TEXT,
        "driver": f"{device.platform.name.strip()} {device.driver_version.strip()}",
    }
