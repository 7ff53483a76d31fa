"""What there is to run on, and which of it to take."""

import os
import re
from dataclasses import dataclass

import pyopencl as cl

from clra.errors import DeviceError


@dataclass(frozen=True)
class DeviceInfo:
    """What a user needs to choose a device.

    Attributes
    ----------
    index : str
        "platform:device", as ``--device`` and ``CLRA_DEVICE`` take it.
    name, platform, version : str
        As the driver gives them.
    kind : str
        "GPU", "CPU" or "other".
    memory, largest_buffer : int
        Bytes of global memory and of the largest single allocation.
    compute_units : int
        Cores of a CPU, multiprocessors of a GPU.
    """

    index: str
    name: str
    platform: str
    version: str
    kind: str
    memory: int
    largest_buffer: int
    compute_units: int


def _all_devices() -> list[tuple[str, cl.Device]]:
    try:
        platforms = cl.get_platforms()
    except cl.Error:  # the ICD loader raises where no driver is registered
        return []
    found = []
    for p, platform in enumerate(platforms):
        try:
            platform_devices = platform.get_devices()
        except cl.Error:  # a platform without devices raises instead of returning none
            continue
        found += [(f"{p}:{d}", device) for d, device in enumerate(platform_devices)]
    return found


def _kind(device: cl.Device) -> str:
    if device.type & cl.device_type.GPU:
        return "GPU"
    return "CPU" if device.type & cl.device_type.CPU else "other"


def devices() -> list[DeviceInfo]:
    """Every OpenCL device of this machine.

    Returns
    -------
    list of DeviceInfo
        Empty where there is none.
    """
    return [
        DeviceInfo(
            index=index,
            name=device.name.strip(),
            platform=device.platform.name.strip(),
            version=device.platform.version.strip(),
            kind=_kind(device),
            memory=device.global_mem_size,
            largest_buffer=device.max_mem_alloc_size,
            compute_units=device.max_compute_units,
        )
        for index, device in _all_devices()
    ]


def choose_device(device: str | cl.Device | None = None) -> cl.Device:
    """Select one device.

    An argument beats the environment variable ``CLRA_DEVICE``, which beats ``PYOPENCL_CTX``, which
    beats the default: the GPU, else the accelerator, else the CPU with the most compute units (of
    two drivers of one name the newer).

    Parameters
    ----------
    device : str or cl.Device, optional
        "platform:device" indices as :func:`devices` lists them, or a part of the device's or
        platform's name or version, for example "nvidia" or "PoCL 3.1".

    Returns
    -------
    cl.Device

    Raises
    ------
    DeviceError
        If there is no device or none that matches; says what was found and how to get PoCL.
    """
    if isinstance(device, cl.Device):
        return device
    found = _all_devices()
    if not found:
        raise DeviceError(
            "no OpenCL device: install a GPU driver with OpenCL, or PoCL for the CPU "
            "(pip install 'clra[pocl]', or apt-get install pocl-opencl-icd)"
        )
    wanted = device or os.environ.get("CLRA_DEVICE") or os.environ.get("PYOPENCL_CTX")
    if wanted:
        for index, candidate in found:
            if wanted in (index, index.partition(":")[0]):
                return candidate
        text = wanted.lower()
        for _, candidate in found:
            platform = candidate.platform
            if text in f"{candidate.name} {platform.name} {platform.version}".lower():
                return candidate
        listing = ", ".join(f"{i} {d.name.strip()} ({d.platform.version})" for i, d in found)
        raise DeviceError(f"no OpenCL device {wanted!r}; found {listing}")
    rank = {"GPU": 2, "other": 1, "CPU": 0}
    return max(
        (candidate for _, candidate in found),
        key=lambda d: (rank[_kind(d)], d.max_compute_units, _numbers(d.platform.version)),
    )


def choose_devices(device: str | cl.Device | None = None) -> list[cl.Device]:
    """Select the devices that share some work.

    Parameters
    ----------
    device : str or cl.Device, optional
        "all": the default device and those of its kind and platform. Else as
        :func:`choose_device` takes it, which selects one.

    Returns
    -------
    list of cl.Device

    Raises
    ------
    DeviceError
        As :func:`choose_device` does.
    """
    if device != "all":
        return [choose_device(device)]
    first = choose_device()
    return [
        other
        for _, other in _all_devices()
        if other.platform == first.platform and _kind(other) == _kind(first)
    ]


def _numbers(version: str) -> list[int]:
    """Numbers in a version, so that 10.0 is newer than 3.1."""
    return [int(number) for number in re.findall(r"\d+", version)]


def create_context(device: str | cl.Device | None = None) -> cl.Context:
    """Context on the device that :func:`choose_device` selects."""
    return cl.Context([choose_device(device)])
