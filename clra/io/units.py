"""Units of lengths and angles as files spell them."""

from __future__ import annotations

from math import pi

TO_MM = {
    "m": 1e3, "metre": 1e3, "meter": 1e3, "metres": 1e3, "meters": 1e3,
    "cm": 10.0, "centimetre": 10.0, "centimeter": 10.0,
    "mm": 1.0, "millimetre": 1.0, "millimeter": 1.0, "millimetres": 1.0, "millimeters": 1.0,
    "um": 1e-3, "µm": 1e-3, "μm": 1e-3, "micron": 1e-3, "microns": 1e-3,
    "micrometre": 1e-3, "micrometer": 1e-3, "micrometres": 1e-3, "micrometers": 1e-3,
    "nm": 1e-6, "nanometre": 1e-6, "nanometer": 1e-6,
}  # fmt: skip
TO_RADIANS = {
    "deg": pi / 180, "degree": pi / 180, "degrees": pi / 180, "°": pi / 180,
    "rad": 1.0, "radian": 1.0, "radians": 1.0, "mrad": 1e-3,
}  # fmt: skip


def factor(unit: str, table: dict[str, float]) -> float | None:
    """Return the factor from `unit` to that of the table, or None where it is unknown."""
    unit = unit.strip()
    return table.get(unit, table.get(unit.lower()))
