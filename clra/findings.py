"""Findings: what the data tell for or against a result, as values."""

from __future__ import annotations

import warnings
from dataclasses import asdict, dataclass, field
from typing import Any, Literal

from clra.errors import ClraWarning

Severity = Literal["info", "warning", "error"]
SEVERITIES: tuple[Severity, ...] = ("info", "warning", "error")


@dataclass(frozen=True)
class Finding:
    """Evidence for or against a result, or against the way in which a scan was read.

    Attributes
    ----------
    code : str
        Short name of the kind of finding, such as "truncation", for programs.
    message : str
        What was found, in one sentence for users.
    advice : str
        What to do about it; may be empty.
    severity : {"info", "warning", "error"}
        "info" is worth knowing, "warning" may spoil the result, "error" does.
    measured : dict of str to float or str
        The numbers behind the message.
    """

    code: str
    message: str
    advice: str = ""
    severity: Severity = "warning"
    measured: dict[str, float | str] = field(default_factory=dict)

    def __str__(self) -> str:
        return f"{self.message}: {self.advice}" if self.advice else self.message

    def as_dict(self) -> dict[str, Any]:
        """Return plain values, for JSON."""
        return asdict(self)

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> Finding:
        """Return the finding that :meth:`as_dict` wrote."""
        return cls(**values)

    def warn(self, stacklevel: int = 2) -> None:
        """Issue it as a :class:`clra.errors.ClraWarning`, unless it is mere information."""
        if self.severity != "info":
            warnings.warn(str(self), ClraWarning, stacklevel=stacklevel + 1)
