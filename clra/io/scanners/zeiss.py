"""Zeiss / Xradia ``.txrm``: an OLE container of radiographs and their metadata.

Sources: a real file (parallel beam, 7 views, with shifts), and the readers dxchange (BSD-3), CIL
(Apache-2.0), xrmreader and txrm2tiff, read for the meaning of the streams. Needs the package
olefile (``pip install 'clra[scanners]'``).

Streams: ``ImageInfo/`` NoOfImages or ImagesTaken, ImageWidth, ImageHeight, DataType (5 is uint16,
10 float32), Angles [degree], StoRADistance and DtoRADistance (source and detector to the axis [mm],
of either sign), pixelsize (at the object [um]), XrayGeometry (1 is a cone, others are parallel),
X/Y/ZPosition [um]; ``ImageData1/Image1`` and so on, 100 a folder; ``ReferenceData/Image``, the open
beam. There are no dark frames: the camera subtracts them.

Signs, as CIL has them: angles turn the sample counter-clockwise seen from above; row 0 is the
bottom, columns count to the right seen from the source. ``Alignment/X-Shifts`` and ``Y-Shifts``
[pixel] are what the vendor's software moves each radiograph by before it reconstructs, toward
higher columns and rows as they are stored (so CIL, xrmreader and txrm2tiff): the radiograph moved
by their opposite, which is offered as start motion. YPosition is taken as the sample's height where
it changes by more than half a pixel.
"""

from __future__ import annotations

import struct
import weakref
from pathlib import Path
from threading import Lock
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clra.errors import InputError
from clra.findings import Finding
from clra.io.key_value_text import MOST
from clra.io.scanners.scanner_options import ScannerOptions
from clra.io.scanners.scanner_scan import (
    ScannerScan,
    assembled,
    assumed,
    unverified,
)
from clra.io.scanners.stage import Floats, stage_geometry
from clra.model.motion import Motion

_TYPES = {
    2: "<i1", 3: "<u1", 4: "<i2", 5: "<u2", 6: "<i4", 7: "<u4", 10: "<f4", 11: "<f8",
}  # fmt: skip
_IN_A_FOLDER = 100
_CONE = 1


class TxrmFile:
    """Streams of a ``.txrm`` file, and its radiographs (views, rows, columns), read as sliced.

    Parameters
    ----------
    path : Path
        The file.

    Raises
    ------
    InputError
        If olefile is not installed, or the file is no OLE container.
    """

    def __init__(self, path: Path) -> None:
        try:
            import olefile
        except ImportError:
            raise InputError(
                f"{path}: .txrm files need the package olefile: pip install 'clra[scanners]'"
            ) from None
        self.path = path
        try:
            self._ole = olefile.OleFileIO(str(path))
        except OSError as error:
            raise InputError(f"{path}: cannot be read as .txrm: {error}") from error
        weakref.finalize(self, self._ole.close)
        self._lock = Lock()  # devices read their views in threads of their own
        self.shape = (
            self.whole("ImageInfo/NoOfImages", "ImageInfo/ImagesTaken"),
            self.whole("ImageInfo/ImageHeight"),
            self.whole("ImageInfo/ImageWidth"),
        )
        taken = self.whole("ImageInfo/ImagesTaken", default=self.shape[0])
        self.shape = (min(self.shape[0], taken), *self.shape[1:])
        code = self.whole("ImageInfo/DataType")
        if code not in _TYPES:
            expected = "5 (uint16) or 10 (float32)"
            raise InputError.at(path, "ImageInfo/DataType", code, expected)
        self.dtype = np.dtype(_TYPES[code])

    def __reduce__(self) -> tuple[Any, ...]:
        return TxrmFile, (self.path.absolute(),)

    def __getitem__(self, index: slice) -> NDArray[Any]:
        """Read some consecutive radiographs."""
        chosen = range(*index.indices(self.shape[0]))
        out = np.empty((len(chosen), *self.shape[1:]), self.dtype)
        for k, view in enumerate(chosen):
            name = f"ImageData{view // _IN_A_FOLDER + 1}/Image{view + 1}"
            out[k] = self._image(name, self.dtype)
        return out

    def reference(self) -> NDArray[Any] | None:
        """Return the radiograph of the open beam, (1, rows, columns), or None."""
        name = "ReferenceData/Image"
        if not self._ole.exists(name):
            return None
        guess = 10 if self._ole.get_size(name) == 4 * self.shape[1] * self.shape[2] else 5
        code = self.whole("ReferenceData/DataType", default=guess)
        image = self._image(name, np.dtype(_TYPES.get(code, "<f4")))[None]
        return image if np.any(image) else None

    def numbers(self, *names: str, letter: str = "f") -> Floats | None:
        """Return the numbers of the first stream that is there, or None."""
        for name in names:
            if self._ole.exists(name):
                data = self._ole.openstream(name).read()
                count = len(data) // 4
                return np.array(struct.unpack(f"<{count}{letter}", data[: 4 * count]), np.float64)
        return None

    def views(self, *names: str) -> Floats | None:
        """Return one number a view, or None where there are none."""
        values = self.numbers(*names)
        return None if values is None or len(values) < self.shape[0] else values[: self.shape[0]]

    def whole(self, *names: str, default: int | None = None) -> int:
        """Return a whole number.

        Raises
        ------
        InputError
            If there is none, without a default.
        """
        values = self.numbers(*names, letter="i")
        if values is not None and len(values) and 0 < values[0] <= MOST:
            return int(values[0])
        if default is None:
            found = "nothing" if values is None or not len(values) else f"{values[0]:g}"
            raise InputError.at(self.path, names[0], found, f"a whole number of 1 to {MOST}")
        return default

    def _image(self, name: str, dtype: np.dtype[Any]) -> NDArray[Any]:
        rows, columns = self.shape[1:]
        with self._lock:
            data = self._ole.openstream(name).read() if self._ole.exists(name) else b""
        if len(data) != rows * columns * dtype.itemsize:
            expected = f"{rows * columns * dtype.itemsize}: {rows} x {columns} pixels of {dtype}"
            raise InputError.at(self.path, name, f"{len(data)} bytes", expected)
        return np.frombuffer(data, dtype).reshape(rows, columns)


def read_zeiss(path: Path, options: ScannerOptions) -> ScannerScan:
    """Read a ``.txrm`` file; the radiographs stay in it until they are asked for.

    Parameters
    ----------
    path : Path
        The file.
    options : ScannerOptions
        What the user says.

    Raises
    ------
    InputError
        If olefile is not installed, a stream is missing or makes no sense.
    """
    file = TxrmFile(path)
    at_object = file.numbers("ImageInfo/pixelsize", "ImageInfo/PixelSize")
    if at_object is None or not at_object[0] > 0:
        found = "nothing" if at_object is None else f"{at_object[0]:g}"
        raise InputError.at(path, "ImageInfo/pixelsize", found, "a size above 0 um")
    parallel = options.parallel or file.whole("ImageInfo/XrayGeometry", default=_CONE) != _CONE
    if options.source_distance is not None and np.isfinite(options.source_distance):
        parallel = options.parallel
    near, far = (1.0, 1.0) if parallel else _distances(file, options)
    edge = 1e-3 * float(at_object[0]) * far / near
    findings = [
        unverified("angles turn counter-clockwise seen from above", "--rotation cw"),
        unverified("row 0 is the bottom, columns to the right seen from the source", "--flip"),
    ]
    degrees = options.degrees(file.views("ImageInfo/Angles"), path)
    heights = options.heights(len(degrees))
    if heights is None:
        heights = _heights(file, 1e-3 * float(at_object[0]), findings)
    geometry = stage_geometry(
        degrees,
        source_to_axis=near,
        source_to_detector=far,
        pixel=options.pixel((edge, edge)),
        shape=(file.shape[1], file.shape[2]),
        rows="bottom",
        heights=heights,
        parallel=parallel,
    )
    reference = file.reference()
    motion = alignment_shifts(file)
    if motion is not None:
        findings.append(
            Finding(
                "unverified-sign",
                "sign not verified on a real scan: Alignment shifts as the opposite of motions",
                "an alignment started from them that ends farther off than one without tells",
                "info",
            )
        )
    if reference is None and options.white is None:
        findings.append(assumed("nothing of the open beam: no ReferenceData", "--white COUNTS"))
    scan = ScannerScan(
        format="Zeiss txrm",
        path=path,
        geometry=geometry,
        frames=file,
        kind="counts",
        flats=reference,
        start_motion=motion,
        details=_details(file, float(at_object[0]), parallel),
        findings=tuple(findings),
    )
    return assembled(scan, options, rotation="ccw")


def alignment_shifts(file: TxrmFile) -> Motion | None:
    """Return the motion that the vendor's shifts undo, of radiographs as stored; None without."""
    x, y = file.views("Alignment/X-Shifts"), file.views("Alignment/Y-Shifts")
    if x is None or y is None or not (np.any(x) or np.any(y)):
        return None
    return Motion(shift_u=-x, shift_v=-y)


def _distances(file: TxrmFile, options: ScannerOptions) -> tuple[float, float]:
    """Return the distances from the source to axis and detector [mm]."""
    near, behind = (
        file.numbers(f"ImageInfo/{name}") for name in ("StoRADistance", "DtoRADistance")
    )
    told = [0.0 if values is None else abs(float(values[0])) for values in (near, behind)]
    chosen = (options.source_distance or told[0], options.detector_distance or told[1])
    for name, value in zip(("StoRADistance", "DtoRADistance"), chosen, strict=True):
        if not value > 0:
            raise InputError.at(file.path, f"ImageInfo/{name}", f"{value:g}", "above 0 mm")
    return chosen[0], chosen[0] + chosen[1]


def _heights(file: TxrmFile, pixel: float, findings: list[Finding]) -> Floats | None:
    """Height of the sample in each view [mm], where the stage moved."""
    position = file.views("ImageInfo/YPosition")
    if position is None or np.ptp(position) * 1e-3 < 0.5 * pixel:
        return None
    findings.append(unverified("YPosition raises the sample", "--z-translation FILE"))
    return np.asarray(1e-3 * (position - position.mean()))


def _details(file: TxrmFile, pixel: float, parallel: bool) -> dict[str, str]:
    """Return what a person reads in the file."""
    details = {"beam": "parallel" if parallel else "cone", "pixel at the object": f"{pixel:g} um"}
    for name, unit in (
        ("Voltage", "kV"), ("Current", "uA"), ("ExpTimes", "s"), ("OpticalMagnification", ""),
        ("StoRADistance", "mm"), ("DtoRADistance", "mm"), ("XrayMagnification", ""),
    ):  # fmt: skip
        values = file.numbers(f"ImageInfo/{name}")
        if values is not None and len(values) and values[0]:
            details[name] = f"{values[0]:g} {unit}".strip()
    motion = alignment_shifts(file)
    if motion is not None:
        x, y = np.abs(motion.shift_u).max(), np.abs(motion.shift_v).max()
        details["alignment shifts"] = f"up to {x:.3g} pixel in x, {y:.3g} in y"
    return details
