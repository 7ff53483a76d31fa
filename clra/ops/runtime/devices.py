"""Device discovery and selection."""

import os
import re
from dataclasses import dataclass

import pyopencl as cl

from clra.errors import DeviceError
from clra.findings import warn
from clra.ops.runtime import intel_driver, self_test
from clra.ops.runtime.cache_folder import cache_folder
from clra.progress import ProgressCallback

_INSTALL = (
    "install a GPU driver with OpenCL, or for the CPU PoCL (pip install 'clra[pocl]', or apt-get "
    "install pocl-opencl-icd) or Intel's runtime (pip install 'clra[intel]')"
)


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
    driver : str
        Version of the driver, in short.
    """

    index: str
    name: str
    platform: str
    version: str
    kind: str
    memory: int
    largest_buffer: int
    compute_units: int
    driver: str


def _all_devices() -> list[tuple[str, cl.Device]]:
    try:
        intel_driver.register(cache_folder())
    except (DeviceError, OSError):  # no folder can be written to; GPUs do without
        pass
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
            driver=_driver(device),
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
        cache_folder()  # raises where PoCL has no folder to work in
        raise DeviceError(f"no OpenCL device: {_INSTALL}")
    wanted = device or _asked_for()
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
    return max((candidate for _, candidate in found), key=_rank)


def _rank(device: cl.Device) -> tuple[int, int, bool, list[int]]:
    """Order of preference; PoCL, where it works, goes before other drivers of a CPU."""
    platform = device.platform
    return (
        {"GPU": 2, "other": 1, "CPU": 0}[_kind(device)],
        device.max_compute_units,
        "Portable Computing Language" in platform.name,
        _numbers(platform.version),
    )


def device_at(index: str) -> cl.Device:
    """Device of a "platform:device" index."""
    return dict(_all_devices())[index]


def usable_device(
    device: str | cl.Device | None = None, progress: ProgressCallback | None = None
) -> cl.Device:
    """Select one device that passes the self-test.

    Parameters
    ----------
    device : str or cl.Device, optional
        As :func:`choose_device` takes it. A device that was asked for, here or by the environment,
        is taken or refused; by default the next best stands in for one that fails.
    progress : callable, optional
        Told before a test, which takes some seconds, once a device and machine.

    Returns
    -------
    cl.Device

    Raises
    ------
    DeviceError
        If there is no such device, or none that passes; says what failed and what to install.

    Warns
    -----
    ClraWarning
        If another device than the best one is taken.
    """
    chosen = choose_device(device)
    found = _all_devices()
    problem = _problem(chosen, found, progress)
    if not problem:
        return chosen
    others = sorted((d for _, d in found if d != chosen), key=_rank, reverse=True)
    if device is None and not _asked_for():
        for other in others:
            if not _problem(other, found, progress):
                warn(
                    "device", f"{problem}: {other.name.strip()} ({_driver(other)}) is used instead"
                )
                return other
    raise DeviceError(
        f"{problem}: update its driver, choose another with --device, or {_INSTALL}; "
        "clra devices --test tests all"
    )


def _problem(
    device: cl.Device,
    found: list[tuple[str, cl.Device]],
    progress: ProgressCallback | None,
) -> str:
    """One line about a device that fails the self-test, else nothing."""
    root = device
    while root.parent_device is not None:
        root = root.parent_device
    index = next((index for index, other in found if other == root), None)
    if index is None:  # of a platform that the loader does not list
        return ""
    failure = self_test.verdict(root, index, progress).failure
    return failure and (f"{root.name.strip()} ({_driver(root)}) fails clra's self-test: {failure}")


def _driver(device: cl.Device) -> str:
    """Platform's version, without what some add of everything they were built with."""
    version = str(device.platform.version).strip().partition("  ")[0]
    own = str(device.driver_version).strip()
    return version if own in version else f"{version}, {own}"


def _asked_for() -> str | None:
    return os.environ.get("CLRA_DEVICE") or os.environ.get("PYOPENCL_CTX")


def usable_devices(
    device: str | cl.Device | None = None, progress: ProgressCallback | None = None
) -> list[cl.Device]:
    """Select the devices that share some work, all of which pass the self-test.

    Parameters
    ----------
    device : str or cl.Device, optional
        "all": the default device and those of its kind and platform. Else as
        :func:`usable_device` takes it, which selects one.
    progress : callable, optional
        As for :func:`usable_device`.

    Returns
    -------
    list of cl.Device

    Raises
    ------
    DeviceError
        As :func:`usable_device` does.
    """
    if device != "all":
        return [usable_device(device, progress)]
    first = usable_device(progress=progress)
    found = _all_devices()
    return [
        other
        for _, other in found
        if other.platform == first.platform
        and _kind(other) == _kind(first)
        and not _problem(other, found, progress)
    ]


def _numbers(version: str) -> list[int]:
    """Numbers in a version, so that 10.0 is newer than 3.1."""
    return [int(number) for number in re.findall(r"\d+", version)]


def create_context(device: str | cl.Device | None = None) -> cl.Context:
    """Context on the device that :func:`usable_device` selects."""
    return cl.Context([usable_device(device)])
