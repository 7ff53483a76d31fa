"""Where CPUs and GPUs differ: the forms of the kernels and the sizes that go with them."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Literal

import pyopencl as cl

from clra.errors import DeviceError


@dataclass(frozen=True)
class DeviceProfile:
    """What operators take from the kind of a device, and nowhere else.

    Attributes
    ----------
    form : {"cpu", "gpu"}
        Form of the kernels. For CPUs a work-item makes a block of a line, in vectors, without a
        work-group; for GPUs neighbouring work-items make neighbouring elements.
    projector_lanes : {1, 8, 16}
        Elements along z, or rows, in a vector of the projectors' kernels.
    image_lanes : {2, 8}
        Columns in a vector of the kernels for images.
    image_group : tuple of int
        Work-group of the kernels for images. GPUs hold few groups at a time, which have to be large
        to fill them.
    reduction_group : int
        Most work-items that share an image in a reduction; 1 on CPUs.
    fft : {"scipy", "reikna"}
        Backend of Fourier transforms.
    shared_memory : bool
        Whether the device works in the host's memory.
    projector_bytes, filter_bytes, warp_bytes, registration_bytes, step_bytes : int
        Scratch memory of one operator where the caller sets no limit: projections in the
        projectors' order, padded lines of the ramp and Katsevich filters, an image of each of the
        warp's two intermediates, everything in registration, and radiographs between two
        operations of an alignment step.
    constant_sizes : bool
        Whether sizes that addresses step by are constants of the kernels' builds. That saves a
        tenth of the instructions and costs a build for each size.
    columns : bool
        Whether views whose v is parallel to z get kernels of their own. False serves tests: the
        kernels for any pose have to agree with them.
    """

    form: Literal["cpu", "gpu"]
    projector_lanes: int
    image_lanes: int
    image_group: tuple[int, int, int]
    reduction_group: int
    fft: Literal["scipy", "reikna"]
    shared_memory: bool
    projector_bytes: int
    filter_bytes: int
    warp_bytes: int
    registration_bytes: int
    step_bytes: int
    constant_sizes: bool = False
    columns: bool = True

    @property
    def on_cpu(self) -> bool:
        """Whether kernels have the form for CPUs."""
        return self.form == "cpu"


# Projections have to stay in a CPU's last cache, and few launches have to read and write the
# volume. Of the filters' lines 2 to 64 MiB differ by 10 % on two cores, of the warp's images 1 to
# 64 MiB by 20 %; twice the memory of registration is 2 % faster and half of it 3 % slower. A GPU
# needs enough work to fill it; its transforms take three times as much memory again. For the
# vectors see vectors.clh.
CPU = DeviceProfile(
    form="cpu",
    projector_lanes=8,
    image_lanes=8,
    image_group=(32, 1, 1),
    reduction_group=1,
    fft="scipy",
    shared_memory=True,
    projector_bytes=24 << 20,
    filter_bytes=8 << 20,
    warp_bytes=8 << 20,
    registration_bytes=128 << 20,
    step_bytes=32 << 20,
)
GPU = DeviceProfile(
    form="gpu",
    projector_lanes=1,
    image_lanes=2,
    image_group=(32, 4, 1),
    reduction_group=256,
    fft="reikna",
    shared_memory=False,
    projector_bytes=256 << 20,
    filter_bytes=32 << 20,
    warp_bytes=32 << 20,
    registration_bytes=512 << 20,
    step_bytes=256 << 20,
    constant_sizes=True,
)
WIDE_CPU = replace(CPU, projector_lanes=16)  # with AVX-512

_forced: list[DeviceProfile] = []


def device_of(owner: cl.Device | cl.Context | cl.CommandQueue) -> cl.Device:
    """Return a device itself, that of a queue, or the only (else first) one of a context."""
    if isinstance(owner, cl.Device):
        return owner
    return owner.device if isinstance(owner, cl.CommandQueue) else owner.devices[0]


def profile_of(owner: cl.Device | cl.Context | cl.CommandQueue) -> DeviceProfile:
    """Return the profile of a device, or of a context's or queue's.

    The environment variable ``CLRA_PROFILE``, "cpu" or "gpu", overrides the device's kind: the GPU
    forms then run on a CPU, to be tested or rehearsed there.

    Raises
    ------
    DeviceError
        If ``CLRA_PROFILE`` is something else.
    """
    if _forced:
        return _forced[-1]
    device = device_of(owner)
    wanted = os.environ.get("CLRA_PROFILE", "")
    if wanted not in ("", "cpu", "gpu"):
        raise DeviceError(f"CLRA_PROFILE: found {wanted!r}, expected 'cpu' or 'gpu'")
    if wanted == "gpu" or not (wanted or device.type & cl.device_type.CPU):
        return GPU
    return WIDE_CPU if device.native_vector_width_float >= 16 else CPU


@contextmanager
def forced(profile: DeviceProfile) -> Iterator[None]:
    """Let every device have this profile for what is made within; for tests, in all threads."""
    _forced.append(profile)
    try:
        yield
    finally:
        _forced.pop()
