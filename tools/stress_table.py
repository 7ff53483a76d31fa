"""Tables of the stress benchmark: a line a scan, a line a kind, and what they add up to."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

Entries = Sequence[dict[str, Any]]

_COLUMNS = (
    ("kind", "kind", "{}"),
    ("seed", "seed", "{}"),
    ("still_error", "not aligned", "{:.3f}"),
    ("free_u", "u", "{:.3f}"),
    ("free_v", "v", "{:.3f}"),
    ("free_m", "m", "{:.1e}"),
    ("raw_u", "raw u", "{:.3f}"),
    ("raw_v", "raw v", "{:.3f}"),
    ("beyond", "beyond", "{:.2f}"),
    ("ratio_u", "err/sigma u", "{:.2f}"),
    ("ratio_v", "v", "{:.2f}"),
    ("ratio_m", "m", "{:.2f}"),
    ("differs", "errors differ", "{:.2f}"),
    ("rank", "rank correlation", "{:.2f}"),
    ("verdict", "verdict", "{}"),
    ("codes", "named", "{}"),
    ("seconds", "CPU s", "{:.1f}"),
)

# Errors from which on a result is wrong, and below which it is right [pixel].
_WRONG, _RIGHT = 0.5, 0.15
# Error over sigma that is honest.
_HONEST = (0.5, 2.0)
# Standard deviation of the logarithm of errors from which on they differ between views: by a factor
# of 2.2 between the sixth of the views where they are smallest and that where they are largest.
_DIFFER = 0.4


def table(entries: Entries) -> str:
    """Return a line a scan, as a Markdown table."""
    rows = []
    for entry in entries:
        shown = {**entry, "codes": " ".join(_codes(entry))}
        values = ((shown.get(key), form) for key, _, form in _COLUMNS)
        rows.append(["" if value is None else form.format(value) for value, form in values])
    return _markdown([title for _, title, _ in _COLUMNS], rows)


def by_kind(entries: Entries) -> str:
    """Return a line a kind: medians over the seeds, verdicts and what was named."""
    rows = []
    for kind in dict.fromkeys(entry["kind"] for entry in entries):
        own = [entry for entry in entries if entry["kind"] == kind]
        cells = [kind, str(len(own))]
        for key, form in (("still_error", "{:.2f}"), ("free_u", "{:.3f}"), ("free_v", "{:.3f}")):
            cells.append(_median(own, key, form))
        cells.append(_median(own, "free_m", "{:.1e}"))
        cells.append(", ".join(_median(own, f"ratio_{axis}", "{:.2f}") for axis in "uvm"))
        verdicts = [entry.get("verdict", "refused") for entry in own]
        cells.append(", ".join(f"{verdicts.count(v)} {v}" for v in dict.fromkeys(verdicts)))
        cells.append(" ".join(dict.fromkeys(code for entry in own for code in _codes(entry))))
        rows.append(cells)
    head = ["kind", "scans", "not aligned", "u", "v", "m", "error / sigma", "verdict", "named"]
    return _markdown(head, rows)


def conclusions(entries: Entries) -> str:
    """Return what verdicts, named causes and standard errors are worth, in lines of text."""
    wrong = [entry for entry in entries if _error(entry) > _WRONG]
    right = [entry for entry in entries if _error(entry) < _RIGHT]
    told = [entry for entry in wrong if entry.get("verdict", "refused") != "good"]
    named = [entry for entry in told if _is_named(entry)]
    alarms = [entry for entry in right if entry.get("verdict", "refused") != "good"]
    lines = [
        f"{len(entries)} scans. Of {len(wrong)} with an error above {_WRONG} pixel {len(told)} are "
        f"doubtful, failed or refused, the right cause is named in {len(named)}; of {len(right)} "
        f"with one below {_RIGHT} pixel {len(alarms)} are."
    ]
    for axis in "uvm":
        ratios = [e[f"ratio_{axis}"] for e in entries if e.get(f"ratio_{axis}")]
        honest = sum(_HONEST[0] <= ratio <= _HONEST[1] for ratio in ratios)
        if ratios:
            lines.append(
                f"Error over sigma in {axis}: {np.median(ratios):.2f} (median), within 0.5 and 2 "
                f"in {honest} of {len(ratios)}."
            )
    ranks = [e["rank"] for e in entries if e.get("differs", 0.0) > _DIFFER]
    if ranks:
        lines.append(
            f"Scans whose errors differ between views: {len(ranks)}; rank correlation with sigma "
            f"{np.median(ranks):.2f} (median), above 0.5 in {sum(r > 0.5 for r in ranks)}."
        )
    return "\n".join(lines) + "\n"


def _error(entry: dict[str, Any]) -> float:
    """Larger gauge-free error of u and v; infinite where the geometry is another scan's."""
    return float(entry.get("error", np.inf))


def _is_named(entry: dict[str, Any]) -> bool:
    return "refused" in entry or bool(set(_codes(entry)) & set(entry["causes"]))


def _codes(entry: dict[str, Any]) -> list[str]:
    return ["refused"] if "refused" in entry else list(entry.get("codes", ()))


def _median(entries: Entries, key: str, form: str) -> str:
    values = [entry[key] for entry in entries if entry.get(key) is not None]
    return form.format(np.median(values)) if values else ""


def _markdown(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [head, ["---"] * len(head), *rows]
    return "".join("| " + " | ".join(cells) + " |\n" for cells in lines)
