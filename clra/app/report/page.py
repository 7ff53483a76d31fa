"""The building blocks of a self-contained HTML page."""

import json
from collections.abc import Iterable, Mapping
from html import escape
from pathlib import Path
from typing import Any

_FOLDER = Path(__file__).parent


def page(title: str, subtitle: str, body: Iterable[str], footer: str) -> str:
    """Whole page; `body` is HTML, the rest is text."""
    return (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{escape(title)}</title>\n<style>\n{_asset('page.css')}</style>\n</head>\n<body>\n"
        "<main>\n"
        f"<header><h1>{escape(title)}</h1>\n<p>{escape(subtitle)}</p></header>\n"
        + "\n".join(body)
        + f"\n<footer>{escape(footer)}</footer>\n</main>\n"
        f"<script>\n{_asset('page.js')}</script>\n</body>\n</html>\n"
    )


def _asset(name: str) -> str:
    return (_FOLDER / name).read_text(encoding="utf-8")


def embedded(data: Any) -> str:
    """Return data for the page's script; nothing in it can end the element."""
    text = json.dumps(data, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")
    return f'<script type="application/json">{text}</script>'


def told(kind: str, what: str, *more: str) -> str:
    """Return a box in the colour of `kind`: info, good, warning, doubtful, error or failed.

    `what` is text, `more` are pieces of HTML.
    """
    return (
        f'<div class="told {kind}"><div class="what">{escape(what)}</div>'
        + "".join(more)
        + "</div>"
    )


def listing(texts: Iterable[str]) -> str:
    """List of texts."""
    return "<ul>" + "".join(f"<li>{escape(text)}</li>" for text in texts) + "</ul>"


def folded(summary: str, *body: str, shown: bool = False) -> str:
    """Part that the reader can fold."""
    opened = " open" if shown else ""
    return f"<details{opened}><summary>{escape(summary)}</summary>" + "".join(body) + "</details>"


def section(title: str, *body: str) -> str:
    """Box with a heading around HTML."""
    return f"<section>\n<h2>{escape(title)}</h2>\n" + "\n".join(body) + "\n</section>"


def paragraph(text: str) -> str:
    """Paragraph of text."""
    return f"<p>{escape(text)}</p>"


def figure(address: str, caption: str, alt: str) -> str:
    """Figure with its caption; `address` is that of an image."""
    return (
        f'<figure><div class="wide"><img src="{address}" alt="{escape(alt)}"></div>'
        f"<figcaption>{escape(caption)}</figcaption></figure>"
    )


def cards(values: Iterable[tuple[str, str, str, str]]) -> str:
    """Key numbers: name, value, unit and a note each."""
    boxes = (
        f'<div class="card"><div class="name">{escape(name)}</div>'
        f'<div class="value">{escape(value)} <span class="unit">{escape(unit)}</span></div>'
        f'<div class="note">{escape(note)}</div></div>'
        for name, value, unit, note in values
    )
    return '<div class="cards">' + "".join(boxes) + "</div>"


def facts(values: Mapping[str, str]) -> str:
    """Table of names and values."""
    rows = (f"<tr><th>{escape(k)}</th><td>{escape(v)}</td></tr>" for k, v in values.items())
    return "<table>" + "".join(rows) + "</table>"


def table(head: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    """Table of numbers under a row of headings; the first column is text."""

    def line(cells: Iterable[str], tag: str) -> str:
        written = (
            f'<{tag} class="{"number" if k else "text"}">{escape(cell)}</{tag}>'
            for k, cell in enumerate(cells)
        )
        return "<tr>" + "".join(written) + "</tr>"

    body = "".join(line(row, "td") for row in rows)
    return f'<div class="wide"><table>{line(head, "th")}{body}</table></div>'


def bars(values: Mapping[str, float], unit: str) -> str:
    """Table of numbers with a bar each."""
    largest = max([*values.values(), 1e-30])
    rows = (
        f'<tr><th>{escape(name)}</th><td class="number">{value:.3f} {escape(unit)}</td>'
        f'<td><span class="bar" style="width:{120 * value / largest:.0f}px"></span></td></tr>'
        for name, value in values.items()
    )
    return "<table>" + "".join(rows) + "</table>"


def columns(parts: Iterable[str]) -> str:
    """Pieces of HTML side by side, as far as there is room."""
    return '<div class="columns">' + "".join(f"<div>{part}</div>" for part in parts) + "</div>"


def pairs(parts: Iterable[str]) -> str:
    """Pieces of HTML two in a row, as far as there is room."""
    return '<div class="pair">' + "".join(parts) + "</div>"


def code(text: str) -> str:
    """Text as it would be typed."""
    return f"<pre>{escape(text)}</pre>"
