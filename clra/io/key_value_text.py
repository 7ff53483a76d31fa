"""Text files of keys and values, with or without sections, as scanners write them."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from pathlib import Path

from clra.errors import InputError

# Views, rows and columns are no more than this: a broken number shall not fill the memory.
MOST = 1_000_000
_NUMBER = re.compile(
    r"([-+]?(?:\d+(?:[.,]\d*)?|[.,]\d+)(?:[eE][-+]?\d+)?)(?:[\s°]*[a-zA-Zµ°%/]*)?$"
)


def read_text(path: Path) -> str:
    """Read a text file in whichever encoding it has.

    Parameters
    ----------
    path : Path
        The file: UTF-8 or UTF-16 with a byte order mark, UTF-8 without one, else Latin-1.

    Raises
    ------
    InputError
        If it cannot be read.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}") from error
    if data[:2] in (b"\xff\xfe", b"\xfe\xff"):
        return data.decode("utf-16", "replace")
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError:
        return data.decode("latin-1")


@dataclass(frozen=True)
class KeyValueText:
    """Keys and values of a text file; case and blanks in keys do not matter.

    Attributes
    ----------
    path : Path
        The file, for messages.
    sections : dict of str to dict of str to str
        Values by section and key; what stands before the first section is in the section "".
    """

    path: Path
    sections: dict[str, dict[str, str]]

    @classmethod
    def read(cls, path: Path, separator: str = "=") -> KeyValueText:
        """Read a file of lines ``key = value``; those of other forms are left out.

        Parameters
        ----------
        path : Path
            The file.
        separator : str
            Between key and value; blanks around it do not matter.

        Raises
        ------
        InputError
            If it cannot be read.
        """
        sections: dict[str, dict[str, str]] = {"": {}}
        current = sections[""]
        for line in read_text(path).splitlines():
            line = line.strip()
            if line.startswith("[") and line.endswith("]"):
                current = sections.setdefault(_plain(line[1:-1]), {})
                continue
            key, found, value = line.partition(separator)
            if found and key.strip() and not line.startswith((";", "#=", "//")):
                current.setdefault(_plain(key), value.strip())
        return cls(path, sections)

    def find(self, *keys: str, section: str | None = None) -> str | None:
        """Return the value of the first key that is there and not empty, or None.

        Parameters
        ----------
        *keys : str
            Spellings, in order of preference.
        section : str, optional
            Where to look; everywhere if not given.
        """
        places = (
            self.sections.values() if section is None else [self.sections.get(_plain(section), {})]
        )
        for key in keys:
            for values in places:
                if values.get(_plain(key)):
                    return values[_plain(key)]
        return None

    def text(self, *keys: str, section: str | None = None) -> str:
        """Return the value of a key that must be there.

        Raises
        ------
        InputError
            If it is missing or empty.
        """
        found = self.find(*keys, section=section)
        if found is None:
            raise InputError.at(self.path, _field(keys, section), "nothing", "a value")
        return found

    def number(
        self,
        *keys: str,
        section: str | None = None,
        default: float | None = None,
        positive: bool = False,
    ) -> float:
        """Return a number; a unit behind it is left out, a decimal comma is read.

        Parameters
        ----------
        *keys : str
            Spellings, in order of preference.
        section : str, optional
            Where to look.
        default : float, optional
            If there is none of the keys; without it one must be there.
        positive : bool
            Whether it has to be above 0.

        Raises
        ------
        InputError
            If it is missing, no number, or not positive.
        """
        expected = "a number above 0" if positive else "a number"
        value = self.find(*keys, section=section)
        if value is None:
            if default is not None:
                return default
            raise InputError.at(self.path, _field(keys, section), "nothing", expected)
        match = _NUMBER.match(value.partition(";")[0].strip())
        number = float(match[1].replace(",", ".")) if match else float("nan")
        if not math.isfinite(number) or (positive and not number > 0):
            raise InputError.at(self.path, _field(keys, section), repr(value[:40]), expected)
        return number

    def whole(self, *keys: str, section: str | None = None, default: int | None = None) -> int:
        """Return a whole number above 0, of views or pixels.

        Raises
        ------
        InputError
            If it is missing or not that.
        """
        value = self.number(
            *keys, section=section, default=None if default is None else float(default)
        )
        if not 1 <= value <= MOST or value != int(value):
            field = _field(keys, section)
            raise InputError.at(self.path, field, f"{value:g}", f"a whole number of 1 to {MOST}")
        return int(value)


def read_table(path: Path, *, whole: bool = True) -> list[list[float]]:
    """Read the rows of a text file that are numbers.

    Parameters
    ----------
    path : Path
        Columns separated by blanks, tabs, commas or semicolons; a colon behind a number is left
        out, and so are lines that do not begin with a number.
    whole : bool
        Leave out lines that hold anything but numbers; else take the numbers they begin with.

    Raises
    ------
    InputError
        If it cannot be read.
    """
    rows = []
    for line in read_text(path).splitlines():
        fields = [field for field in re.split(r"[\s,;]+", line.strip()) if field]
        numbers = _numbers(fields)
        if numbers and (len(numbers) == len(fields) or not whole):
            rows.append(numbers)
    return rows


def _numbers(fields: list[str]) -> list[float]:
    """Return the numbers that a line begins with."""
    numbers: list[float] = []
    for field in fields:
        try:
            numbers.append(float(field.rstrip(":")))
        except ValueError:
            break
    return numbers


def _plain(key: str) -> str:
    return " ".join(key.lower().split())


def _field(keys: tuple[str, ...], section: str | None) -> str:
    name = " or ".join(keys)
    return f"[{section}] {name}" if section else name
