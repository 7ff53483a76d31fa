"""Findings: what the data tell for or against a result, as values."""

from __future__ import annotations

import logging
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal

from clra.errors import ClraWarning

Severity = Literal["info", "warning", "error"]


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

    def warn(self) -> Finding:
        """Issue it as a :class:`clra.errors.ClraWarning` that points at the line that called clra.

        Mere information is logged instead. Either goes to :func:`collected`.
        """
        if self.severity == "info" or _SILENT.get():
            return self.record()
        self._collect()
        warnings.warn(str(self), ClraWarning, stacklevel=_callers_level())
        return self

    def record(self) -> Finding:
        """Log it and hand it to :func:`collected`, for a result that tells it itself."""
        self._collect()
        _LOG.info("%s", self)
        return self

    def _collect(self) -> None:
        for findings in _COLLECTING.get():
            if self not in findings:
                findings.append(self)


def warn(code: str, message: str, advice: str = "") -> None:
    """Issue a finding of severity "warning"; see :class:`Finding`."""
    Finding(code, message, advice).warn()


@contextmanager
def collected(*, silent: bool = False) -> Iterator[list[Finding]]:
    """Yield a list to which every finding that is issued within the block is appended, once.

    Parameters
    ----------
    silent : bool
        Issue no warnings: whoever asked for the work, elsewhere, issues the findings again.
    """
    findings: list[Finding] = []
    token = _COLLECTING.set((*_COLLECTING.get(), findings))
    before = _SILENT.set(silent or _SILENT.get())
    try:
        yield findings
    finally:
        _COLLECTING.reset(token)
        _SILENT.reset(before)


def collected_so_far(*, outermost: bool = False) -> tuple[Finding, ...]:
    """Return the findings that the innermost, or the outermost, :func:`collected` has by now."""
    lists = _COLLECTING.get()
    return tuple(lists[0 if outermost else -1]) if lists else ()


_LOG = logging.getLogger(__name__)
_COLLECTING: ContextVar[tuple[list[Finding], ...]] = ContextVar("collecting", default=())
_SILENT: ContextVar[bool] = ContextVar("silent", default=False)
_PACKAGE = str(Path(__file__).parent)


def _callers_level() -> int:
    """Stack level, for the function that asks, of the frame that called this package."""
    frame, level, outermost = sys._getframe(1), 1, 1
    while frame is not None:
        # Standard library frames between two of ours (contextlib) are no callers.
        if frame.f_code.co_filename.startswith(_PACKAGE):
            outermost = level
        frame, level = frame.f_back, level + 1  # type: ignore[assignment]
    return outermost + 1
