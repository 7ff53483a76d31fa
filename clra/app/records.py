"""A finished alignment in MOTION.h5, and back."""

import json
import math
import os
from collections.abc import Mapping
from dataclasses import MISSING, dataclass, field, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clra.app.plausible import doubt_of_turning
from clra.app.scan_description import path_of
from clra.io.motion_file import MotionFile, read_motion_file, write_motion_file
from clra.io.scan_files import scan_checksum
from clra.methods.alignment.rejected_views import all_but
from clra.methods.alignment.result import AlignmentResult, Iteration
from clra.model.motion import Motion
from clra.model.scan import Scan


@dataclass(frozen=True)
class Record:
    """What is known of an alignment, whether it just ended or was read from a file.

    Attributes
    ----------
    motion : Motion
        As estimated.
    confidence : ndarray, (views,)
        0 to 1; 0 for a view that is rejected. All 1 where a file does not tell.
    flagged : tuple of int
        Views that are rejected.
    history : tuple of Iteration
        Of the run.
    gauge : mapping of str to float
        RMS of the motion along each mode [pixel].
    sigma : (float, float, float) or None
        Median standard errors of shift_u, shift_v [pixel] and magnification.
    about : mapping of str to str
        Where it comes from: "scan", "checksum", "path" (the trajectory's kind), "schedule",
        "estimate", "unobservable" (whether the gauge was "taken out" of the motion or "left in"),
        "device", "command", "version", as far as known.
    """

    motion: Motion
    confidence: NDArray[np.float64]
    flagged: tuple[int, ...] = ()
    history: tuple[Iteration, ...] = ()
    gauge: Mapping[str, float] = field(default_factory=dict)
    sigma: tuple[float, float, float] | None = None
    about: Mapping[str, str] = field(default_factory=dict)

    @property
    def valid_views(self) -> NDArray[np.bool_]:
        """Views but for the flagged ones, (views,)."""
        return all_but(self.flagged, self.motion.views)

    @property
    def notes(self) -> tuple[str, ...]:
        """What the run warned of."""
        told = [note for step in self.history for note in step.note.splitlines()]
        try:
            told.append(doubt_of_turning(float(self.about["sharpening_by_turning_back"])))
        except (KeyError, ValueError):
            pass  # not looked at
        return tuple(filter(None, told))

    @property
    def scale_estimated(self) -> bool:
        """Whether magnifications were estimated."""
        return bool(np.any(self.motion.magnification != 1))

    @classmethod
    def of(
        cls, result: AlignmentResult, scan: Scan, earlier: "Record | None" = None, /, **about: str
    ) -> "Record":
        """Keep a result.

        Parameters
        ----------
        result : AlignmentResult
            Of the scan.
        scan : Scan
            Three of its radiographs are read for a checksum.
        earlier : Record, optional
            Of the run that it started from: its history comes first, and the detector is still
            where an auto-focus found it then.
        **about : str
            What else is to be remembered.
        """
        u, v, m = np.median(result.sigma, axis=0).tolist()
        before = () if earlier is None else earlier.history
        known = {} if earlier is None else earlier.about
        detector = {name: told for name, told in known.items() if name.startswith("detector_")}
        return cls(
            motion=result.motion,
            confidence=result.confidence,
            flagged=result.flagged,
            history=(*before, *result.history),
            gauge=result.gauge,
            sigma=(u, v, m),
            about={
                "scan": scan.name,
                "checksum": scan_checksum(scan),
                "path": path_of(scan.geometry).kind,
                "schedule": result.schedule,
                "device": result.device,
                **_source_travel(result.motion, scan),
                **detector,
                **about,
            },
        )

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write MOTION.h5.

        Parameters
        ----------
        path : path-like
            The file; appears whole or not at all.

        Raises
        ------
        OutputError
            If it cannot be written.
        """
        own = ("scan", "checksum", "schedule", "device")
        sigma = dict(zip(_SIGMA, self.sigma, strict=True)) if self.sigma else {}
        write_motion_file(
            path,
            self.motion,
            confidence=self.confidence,
            flagged=self.flagged,
            history=self.history,
            **{key: self.about.get(key, "") for key in own},
            attributes={
                "gauge": json.dumps(dict(self.gauge)),
                **sigma,
                **{k: v for k, v in self.about.items() if k not in (*own, "version")},
            },
        )

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> "Record":
        """Read MOTION.h5.

        Parameters
        ----------
        path : path-like
            The file; only its shifts must be there.

        Raises
        ------
        InputError
            If it is no motion file.
        """
        file = read_motion_file(path)
        about = {k: v for k, v in file.attributes.items() if k not in ("gauge", *_SIGMA)}
        unknown = np.ones(file.motion.views)
        return cls(
            motion=file.motion,
            confidence=unknown if file.confidence is None else file.confidence,
            flagged=file.flagged,
            history=history_of(file),
            gauge=_gauge(file),
            sigma=_sigma(file),
            about=about,
        )


_SIGMA = ("sigma_u", "sigma_v", "sigma_magnification")


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


def history_of(file: MotionFile) -> tuple[Iteration, ...]:
    """Return the iterations that a file tells; none if another version wrote too few columns."""
    needed = {f.name for f in fields(Iteration) if f.default is MISSING}
    names = [f.name for f in fields(Iteration) if f.name in file.history]
    if not needed <= set(names):
        return ()
    rows = zip(*(file.history[name].tolist() for name in names), strict=True)
    return tuple(Iteration(**dict(zip(names, map(_known, row), strict=True))) for row in rows)


def _known(value: Any) -> Any:
    return None if isinstance(value, float) and math.isnan(value) else value


def _gauge(file: MotionFile) -> dict[str, float]:
    try:
        return {str(k): float(v) for k, v in json.loads(file.attributes["gauge"]).items()}
    except (KeyError, ValueError, AttributeError):
        return {}


def _sigma(file: MotionFile) -> tuple[float, float, float] | None:
    try:
        u, v, m = (float(file.attributes[name]) for name in _SIGMA)
    except (KeyError, ValueError):
        return None
    return u, v, m
