"""``clra import``: raw frames and a table of angles become an NXtomo file."""

from __future__ import annotations

import os
from collections.abc import Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from clra.errors import InputError
from clra.findings import warn
from clra.io.atomic import ensure_writable
from clra.io.frames.stacks import FrameStack, RawLayout, Source, read_numbers, warn_of_gaps
from clra.io.frames.turned import TurnedFrames
from clra.io.nxtomo.clra_group import KINDS
from clra.io.nxtomo.geometry_fields import Fields, far_source_distance
from clra.io.nxtomo.writer import write_nxtomo
from clra.model.validation import all_but
from clra.progress import ProgressCallback

# Angles that all lie within this [degree] are warned of: a whole turn is 6.28 rad.
_NARROW = 7.0


@dataclass(frozen=True)
class Imported:
    """What was written.

    Attributes
    ----------
    views, flats, darks : int
        Frames of each role.
    shape : (int, int)
        Their rows and columns.
    angles_deg : (float, float)
        Turn of the sample at the first and at the last radiograph.
    """

    views: int
    flats: int
    darks: int
    shape: tuple[int, int]
    angles_deg: tuple[float, float]


def import_frames(
    out: str | os.PathLike[str],
    frames: Source | Sequence[Source],
    angles: Source | ArrayLike,
    *,
    source_distance: float | None = None,
    detector_distance: float | None = None,
    pixel_size: float | tuple[float, float],
    parallel: bool = False,
    flats: Source | Sequence[Source] = (),
    flats_after: Source | Sequence[Source] = (),
    darks: Source | Sequence[Source] = (),
    kind: str = "counts",
    shape: tuple[int, int] | None = None,
    dtype: str = "uint16",
    byteorder: str = "little",
    header: int = 0,
    z_translation: Source | ArrayLike | None = None,
    centre_offset: float = 0.0,
    rotation: str = "ccw",
    axis: str = "vertical",
    exclude: Sequence[int] = (),
    name: str | None = None,
    progress: ProgressCallback | None = None,
) -> Imported:
    """Write raw frames as an NXtomo scan, frame by frame; it appears whole or not at all.

    Row 0 of a frame is its top; columns count to the right as seen from the source.

    Parameters
    ----------
    out : path-like
        The NXtomo file.
    frames : path-like or list of path-like
        TIFF files of one or more grey pages, or headerless binary files; a pattern such as
        ``scan/*.tif`` is sorted by the numbers in the names.
    angles : path-like, str or array_like
        Turn of the sample at each frame, a text file with a number a line, ``start:stop:n`` with
        both ends included, or numbers [degree].
    source_distance : float
        From source to rotation axis [mm]; infinite, or left out with `parallel`, for a parallel
        beam.
    detector_distance : float
        From rotation axis to detector [mm].
    pixel_size : float or (float, float)
        Of the detector; (row, column) steps where they differ [mm].
    parallel : bool
        The beam is parallel: a source so far away that rays end within 1/8000 of the detector's
        width of where parallel ones would, and the detector at the axis, so that a voxel is a
        pixel.
    flats, flats_after : path-like or list of path-like, optional
        Frames of the open beam, taken before and after the radiographs: with both, each radiograph
        is divided by what lies between, for its place.
    darks : path-like or list of path-like, optional
        Frames without beam.
    kind : {"counts", "transmission", "line-integrals"}
        What the frames hold; only counts take flats and darks.
    shape : (int, int), optional
        Rows and columns of headerless frames.
    dtype : str
        Type of their pixels, such as "uint16".
    byteorder : {"little", "big"}
        Of their pixels.
    header : int
        Bytes to skip at the start of each of their files.
    z_translation : path-like, str or array_like, optional
        How far the sample is raised at each frame, given like `angles` [mm].
    centre_offset : float
        Column at which the rotation axis is seen, from the detector's middle, positive toward
        higher columns [pixel].
    rotation : {"ccw", "cw"}
        How the sample turns as its angle grows, seen from above.
    axis : {"vertical", "horizontal"}
        How the rotation axis runs in the frames. Of a horizontal one the right end becomes the top:
        the frames are turned by 90 degrees as they are copied, and `shape` and `pixel_size` are of
        the frames as they are stored. If it is the left end that is up, give the other `rotation`.
    exclude : sequence of int
        Radiographs that are marked as invalid, from 0: readers leave them out.
    name : str, optional
        Title of the scan; the name of `out` if not given.
    progress : callable, optional
        Called with a ``Progress`` as frames are written.

    Returns
    -------
    Imported

    Raises
    ------
    InputError
        If frames, angles or numbers do not fit; nothing is written then.
    OutputError
        If `out` cannot be written.
    """
    layout = RawLayout(shape=shape, dtype=dtype, byteorder=byteorder, header=header)
    if kind not in KINDS:
        raise InputError.at("--kind", "kind", repr(kind), f"one of {', '.join(KINDS)}")
    if kind != "counts" and any(map(_any, (flats, flats_after, darks))):
        raise InputError.at("--kind", "kind", f"{kind!r} and flats or darks", "neither of them")
    with ExitStack() as files:
        stack, bright, after, dark = (
            files.enter_context(closing(_opened(given, layout, axis))) if _any(given) else None
            for given in (frames, flats, flats_after, darks)
        )
        if stack is None:
            raise InputError("frames: found no file, expected at least one")
        stacks = [part for part in (stack, bright, after, dark) if part is not None]
        tables = [
            given for given in (angles, z_translation) if isinstance(given, str | os.PathLike)
        ]
        ensure_writable(out, keep=[*tables, *(file for part in stacks for file in part.files)])
        for part in stacks:
            if part.shape[1:] != stack.shape[1:]:
                found = f"{part.shape[1:]} pixels"
                raise InputError.at(part.files[0], "frame", found, f"{stack.shape[1:]}")
        views, detector = stack.shape[0], stack.shape[1:]
        if kind != "counts" and stack.dtype.kind != "f":
            raise InputError.at(
                stack.files[0], "pixels", stack.dtype, f"floating point, as {kind} have it"
            )
        warn_of_gaps(stack.files)
        told = "of" if len(stack.files) == 1 else f"from {stack.files[0].name} to"
        told += f" {stack.files[-1].name}"
        row_step, column_step = _pixel(pixel_size)
        if axis == "horizontal":
            row_step, column_step = column_step, row_step
        valid_views = all_but(exclude, views)
        if rotation not in ("ccw", "cw"):
            raise InputError.at("--rotation", "rotation", repr(rotation), "ccw or cw")
        degrees = read_numbers(angles, "angles", views, told)
        if views > 2 and np.ptp(degrees) < _NARROW:
            warn(
                "import",
                f"angles go from {degrees.min():g} to {degrees.max():g}, and are taken as degrees",
            )
        turn = np.deg2rad(degrees)
        propagation = None
        if parallel or (source_distance is not None and np.isinf(source_distance)):
            near, behind = far_source_distance(detector, column_step), 0.0
            propagation = detector_distance
        else:
            near = _distance("source_distance", source_distance)
            behind = _distance("detector_distance", detector_distance)
        translation = np.zeros((views, 3))
        # Moving the axis rather than the detector keeps to what NXtomo can say.
        translation[:, 0] = centre_offset * column_step * near / (near + behind)
        if z_translation is not None:
            translation[:, 2] = read_numbers(z_translation, "z_translation", views, told)
        fields = Fields(
            angle=turn if rotation == "ccw" else -turn,
            translation=translation,
            source_distance=np.full(views, near),
            detector_distance=np.full(views, behind),
            pixel=(column_step, row_step),
        )
        write_nxtomo(
            out,
            stack,
            fields.geometry(detector),
            flats=bright,
            flats_after=after,
            darks=dark,
            kind=kind,
            dtype=np.result_type(*(part.dtype for part in stacks)),
            name=name or os.path.basename(os.fspath(out)),
            valid_views=valid_views,
            fields=fields,
            propagation_distance=propagation,
            progress=progress,
        )
        return Imported(
            views=views,
            flats=sum(part.shape[0] for part in (bright, after) if part is not None),
            darks=0 if dark is None else dark.shape[0],
            shape=detector,
            angles_deg=(float(degrees[0]), float(degrees[-1])),
        )


def _opened(
    given: Source | Sequence[Source], layout: RawLayout, axis: str
) -> FrameStack | TurnedFrames:
    """Open frames; turn them if the axis lies in them."""
    if axis not in ("vertical", "horizontal"):
        raise InputError.at("--axis", "axis", repr(axis), "vertical or horizontal")
    stack = FrameStack(given, layout)
    return stack if axis == "vertical" else TurnedFrames(stack)


def _any(files: Source | Sequence[Source]) -> bool:
    return isinstance(files, str | os.PathLike) or len(files) > 0


def _distance(name: str, value: float | None) -> float:
    """Check a distance in front of or behind the sample."""
    if value is None or not np.isfinite(value) or value <= 0:
        option = f"--{name.replace('_', '-')}"
        hint = " (or --parallel)" if name == "source_distance" else ""
        raise InputError.at(option, name, value, f"a distance above 0 mm{hint}")
    return float(value)


def _pixel(size: float | tuple[float, float]) -> tuple[float, float]:
    """Check the size of a pixel; return (row, column) steps."""
    steps = np.asarray(size, np.float64).ravel()
    if steps.size not in (1, 2) or not (np.isfinite(steps).all() and (steps > 0).all()):
        raise InputError.at("--pixel-size", "pixel_size", size, "one or two sizes above 0 mm")
    return float(steps[0]), float(steps[-1])
