"""Motion correction for cone-beam X-ray micro-CT: re-projection alignment on any OpenCL device.

The public names are handed on lazily (PEP 562), so that ``import clra`` is quick and touches no
OpenCL; each lives in the module that the table below names.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:  # the same for type checkers, which do not follow the table
    __version__: str
    from clra import kernels as kernels
    from clra.errors import Cancelled as Cancelled
    from clra.errors import ClraWarning as ClraWarning
    from clra.errors import DeviceError as DeviceError
    from clra.errors import InputError as InputError
    from clra.errors import OutputError as OutputError
    from clra.findings import Finding as Finding
    from clra.io.alignment_file import read_alignment as read_alignment
    from clra.io.alignment_file import write_alignment as write_alignment
    from clra.io.scan_files import read_scan as read_scan
    from clra.io.scan_files import write_scan as write_scan
    from clra.io.scanners.recognise import read_start_motion as read_start_motion
    from clra.io.scanners.scanner_options import ScannerOptions as ScannerOptions
    from clra.io.volumes.volume_files import write_volume as write_volume
    from clra.methods.alignment.align import align as align
    from clra.methods.alignment.alignment_step import AlignmentStep as AlignmentStep
    from clra.methods.alignment.result import AlignmentResult as AlignmentResult
    from clra.methods.correction import correct as correct
    from clra.methods.reconstruction.iterative import Multigrid as Multigrid
    from clra.methods.reconstruction.osem_tr import OrderedSubsets as OrderedSubsets
    from clra.methods.reconstruction.reconstruct import reconstruct as reconstruct
    from clra.model.geometry import ConeBeamGeometry as ConeBeamGeometry
    from clra.model.grid import VolumeGrid as VolumeGrid
    from clra.model.motion import Motion as Motion
    from clra.model.scan import Scan as Scan
    from clra.model.trajectory import circular as circular
    from clra.model.trajectory import double_helix as double_helix
    from clra.model.trajectory import helix as helix
    from clra.model.trajectory import space_filling as space_filling
    from clra.ops.projection.linear_operator import as_linear_operator as as_linear_operator
    from clra.ops.projection.projector import BackProjector as BackProjector
    from clra.ops.projection.projector import ForwardProjector as ForwardProjector
    from clra.ops.runtime.devices import devices as devices
    from clra.progress import Progress as Progress

_HOMES = {
    "ConeBeamGeometry": "clra.model.geometry",
    "circular": "clra.model.trajectory",
    "helix": "clra.model.trajectory",
    "double_helix": "clra.model.trajectory",
    "space_filling": "clra.model.trajectory",
    "VolumeGrid": "clra.model.grid",
    "Motion": "clra.model.motion",
    "Scan": "clra.model.scan",
    "read_scan": "clra.io.scan_files",
    "write_scan": "clra.io.scan_files",
    "ScannerOptions": "clra.io.scanners.scanner_options",
    "read_start_motion": "clra.io.scanners.recognise",
    "read_alignment": "clra.io.alignment_file",
    "write_alignment": "clra.io.alignment_file",
    "write_volume": "clra.io.volumes.volume_files",
    "align": "clra.methods.alignment.align",
    "AlignmentResult": "clra.methods.alignment.result",
    "reconstruct": "clra.methods.reconstruction.reconstruct",
    "OrderedSubsets": "clra.methods.reconstruction.osem_tr",
    "Multigrid": "clra.methods.reconstruction.iterative",
    "correct": "clra.methods.correction",
    "devices": "clra.ops.runtime.devices",
    "ForwardProjector": "clra.ops.projection.projector",
    "BackProjector": "clra.ops.projection.projector",
    "AlignmentStep": "clra.methods.alignment.alignment_step",
    "Finding": "clra.findings",
    "Progress": "clra.progress",
    "InputError": "clra.errors",
    "OutputError": "clra.errors",
    "DeviceError": "clra.errors",
    "Cancelled": "clra.errors",
    "ClraWarning": "clra.errors",
    "as_linear_operator": "clra.ops.projection.linear_operator",
}

__all__ = ["__version__", "kernels", *_HOMES]


def __getattr__(name: str) -> Any:
    if name == "kernels":
        return import_module("clra.kernels")
    if name == "__version__":
        from importlib.metadata import PackageNotFoundError, version

        try:
            return version("clra")
        except PackageNotFoundError:
            return "unknown"  # run from a checkout that is not installed
    if name in _HOMES:
        return getattr(import_module(_HOMES[name]), name)
    raise AttributeError(f"module 'clra' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)
