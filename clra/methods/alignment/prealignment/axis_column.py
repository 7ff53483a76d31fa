"""The column of the axis of an arc, where an alignment begins."""

import math
from collections.abc import Callable

from clra.errors import InputError
from clra.methods.assessment.axis_of_arc import axis_offset
from clra.model.sampling.angular_coverage import covered, is_circle
from clra.model.scan import Scan
from clra.ops.streaming.radiographs import Radiographs
from clra.ops.streaming.stream import Stream

# Smallest offset that counts [pixel], and how much better the rays of a line have to agree: jitter
# of 4 pixels makes an error of 1.
_LEAST, _BETTER = 1.5, 1.5


def axis_column(stream: Stream, scan: Scan, radiographs: Callable[[], Radiographs]) -> float:
    """Return how far the axis is seen from where the geometry has it, if rays tell.

    On less than a turn a shift of all views resembles a movement of the sample across the beam,
    which alignment takes out as the sample's: along the beam it would have moved, too, and that
    looks like magnification. With an axis aside by 6 of 128 columns a half turn ended at 0.10
    pixel and 5e-3, at 0.011 and 3e-4 where the shift was known.

    Parameters
    ----------
    stream : Stream
        Memory budget, and whom to tell how far it is.
    scan : Scan
        Of any trajectory.
    radiographs : callable
        Returns those of the scan, all of which are read if it is an arc.

    Returns
    -------
    float
        Toward higher columns [pixel]; 0 where it is small, or no ray is measured twice.
    """
    if not is_circle(scan.geometry) or covered(scan.geometry) == 2 * math.pi:
        return 0.0
    try:
        offset, gain = axis_offset(stream, scan, radiographs())
    except InputError:
        return 0.0
    return offset if abs(offset) >= _LEAST and gain >= _BETTER else 0.0
