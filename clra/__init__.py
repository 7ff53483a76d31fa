"""Motion correction for cone-beam X-ray micro-CT: re-projection alignment on any OpenCL device.

The public names are handed on lazily (PEP 562), so that ``import clra`` is quick and touches no
OpenCL; each lives in the module that the table below names.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:  # the same for type checkers, which do not follow the table
    from clra import kernels as kernels
    from clra.io.scans import read_scan as read_scan
    from clra.methods.alignment import align as align
    from clra.methods.correction import correct as correct
    from clra.methods.reconstruction import reconstruct as reconstruct
    from clra.model.geometry import ConeBeamGeometry as ConeBeamGeometry
    from clra.model.grid import VolumeGrid as VolumeGrid
    from clra.model.motion import Motion as Motion
    from clra.model.scan import Scan as Scan
    from clra.model.trajectory import circular as circular
    from clra.model.trajectory import double_helix as double_helix
    from clra.model.trajectory import helix as helix
    from clra.model.trajectory import space_filling as space_filling
    from clra.ops.alignment_step import AlignmentStep as AlignmentStep
    from clra.ops.devices import devices as devices
    from clra.ops.linear import as_linear_operator as as_linear_operator
    from clra.ops.projector import BackProjector as BackProjector
    from clra.ops.projector import ForwardProjector as ForwardProjector

_HOMES = {
    "ConeBeamGeometry": "clra.model.geometry",
    "circular": "clra.model.trajectory",
    "helix": "clra.model.trajectory",
    "double_helix": "clra.model.trajectory",
    "space_filling": "clra.model.trajectory",
    "VolumeGrid": "clra.model.grid",
    "Motion": "clra.model.motion",
    "Scan": "clra.model.scan",
    "read_scan": "clra.io.scans",
    "align": "clra.methods.alignment",
    "reconstruct": "clra.methods.reconstruction",
    "correct": "clra.methods.correction",
    "devices": "clra.ops.devices",
    "ForwardProjector": "clra.ops.projector",
    "BackProjector": "clra.ops.projector",
    "AlignmentStep": "clra.ops.alignment_step",
    "as_linear_operator": "clra.ops.linear",
}

__all__ = ["kernels", *_HOMES]


def __getattr__(name: str) -> Any:
    if name == "kernels":
        return import_module("clra.kernels")
    if name in _HOMES:
        return getattr(import_module(_HOMES[name]), name)
    raise AttributeError(f"module 'clra' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)
