"""Where an output comes from: kept in the file itself."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

import clra
from clra.model.grid import VolumeGrid
from clra.model.scan import Scan

if TYPE_CHECKING:  # which imports OpenCL, and volumes are read and written without
    from clra.methods.alignment.result import AlignmentResult

Provenance = Mapping[str, str]


def provenance(
    *,
    command: str = "",
    scan: Scan | None = None,
    alignment: AlignmentResult | None = None,
    method: str = "",
    options: Any = None,
    grid: VolumeGrid | None = None,
) -> dict[str, str]:
    """Return what an output is to tell of its making, as texts by name.

    Parameters
    ----------
    command : str
        The command line or the call.
    scan : Scan, optional
        From which; :meth:`Scan.checksum` tells it from others.
    alignment : AlignmentResult, optional
        By which; its fingerprint tells it from others.
    method : str
        Of the reconstruction.
    options : dataclass instance or mapping, optional
        Of the method.
    grid : VolumeGrid, optional
        Where to.

    Returns
    -------
    dict of str to str
        "clra_version" and what was given.
    """
    told = {"clra_version": clra.__version__, "command": command, "method": method}
    if scan is not None:
        told |= {"scan": scan.name, "scan_checksum": scan.checksum()}
    if alignment is not None:
        told["alignment_checksum"] = alignment.checksum_of_motion()
    if options is not None:
        told["options"] = json.dumps(_values(options))
    if grid is not None:
        told["grid"] = json.dumps(_values(grid))
    return {name: text for name, text in told.items() if text}


def _values(value: Any) -> dict[str, Any]:
    """Return the fields of a dataclass, or a mapping, as JSON takes them."""
    items = (
        {f.name: getattr(value, f.name) for f in dataclasses.fields(value)}
        if dataclasses.is_dataclass(value)
        else dict(value)
    )
    return {name: "array" if isinstance(v, np.ndarray) else v for name, v in items.items()}
