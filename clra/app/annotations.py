"""What the command line adds to an alignment before it is kept."""

from dataclasses import replace

import numpy as np

from clra.app.scan_description import path_of
from clra.methods.alignment.result import AlignmentResult
from clra.model.motion import Motion
from clra.model.scan import Scan


def annotated(
    result: AlignmentResult,
    scan: Scan,
    earlier: AlignmentResult | None = None,
    /,
    *,
    command: str = "",
    **about: str,
) -> AlignmentResult:
    """Add where an alignment comes from, for those who read its file.

    Parameters
    ----------
    result : AlignmentResult
        Of the scan.
    scan : Scan
        With its geometry.
    earlier : AlignmentResult, optional
        Of the run that it started from: its history comes first, and the detector is still where
        an auto-focus found it then.
    command : str
        The command line.
    **about : str
        What else is to be remembered.
    """
    before = () if earlier is None else earlier.history
    known = {} if earlier is None else earlier.about
    detector = {name: told for name, told in known.items() if name.startswith("detector_")}
    return replace(
        result,
        history=(*before, *result.history),
        command=command,
        about={
            **result.about,
            "path": path_of(scan.geometry).kind,
            **_source_travel(result.motion, scan),
            **detector,
            **about,
        },
    )


def _source_travel(motion: Motion, scan: Scan) -> dict[str, str]:
    """Say how far the source went, if it did."""
    if motion.cause != "source":
        return {}
    geometry, moved = scan.geometry, scan.geometry.source_displacement(motion)
    ranges = [
        1e3 * float(np.ptp(np.sum(moved * axis, axis=1) / np.linalg.norm(axis, axis=1)))
        for axis in (geometry.u, geometry.v, geometry.normal)
    ]
    across, along, toward = (f"{length:.3g}" for length in ranges)
    return {"source_travel": f"{across}, {along}, {toward} um along columns, rows and beam"}
