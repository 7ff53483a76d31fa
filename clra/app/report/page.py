"""The building blocks of a self-contained HTML page."""

from collections.abc import Iterable, Mapping
from html import escape

_CSS = """
:root { --ink: #26323d; --soft: #5b6875; --line: #dfe5ea; --accent: #0072b2; --paper: #fff; }
* { box-sizing: border-box; }
body { margin: 0; background: #f3f5f7; color: var(--ink); line-height: 1.55;
  font: 15.5px/1.55 system-ui, "Segoe UI", Roboto, "Helvetica Neue", "DejaVu Sans", sans-serif; }
main { max-width: 1100px; margin: 0 auto; padding: 2.4rem 1.4rem 3rem; }
h1 { font-size: 1.75rem; line-height: 1.2; margin: 0 0 .3rem; letter-spacing: -.01em; }
h2 { font-size: 1.12rem; margin: 0 0 .8rem; }
p { margin: 0 0 .8rem; max-width: 46rem; }
header p { color: var(--soft); margin-bottom: 1.4rem; }
section { background: var(--paper); border: 1px solid var(--line); border-radius: 10px;
  padding: 1.2rem 1.4rem 1.1rem; margin: 0 0 1.1rem; }
.cards { display: grid; grid-template-columns: repeat(auto-fit, minmax(285px, 1fr)); gap: .7rem;
  margin: 0 0 1.1rem; }
.card { background: var(--paper); border: 1px solid var(--line); border-radius: 10px;
  padding: .75rem 1rem .8rem; }
.card .name { color: var(--soft); font-size: .82rem; }
.card .value { font-size: 1.4rem; font-weight: 600; line-height: 1.3;
  font-variant-numeric: tabular-nums; }
.card .unit { font-size: .85rem; font-weight: 400; color: var(--soft); }
.card .note { color: var(--soft); font-size: .8rem; line-height: 1.35; }
figure { margin: 0 0 1.1rem; }
figure:last-child { margin-bottom: .2rem; }
figure img { display: block; width: 100%; height: auto; }
figcaption { color: var(--soft); font-size: .88rem; margin-top: .45rem; max-width: 52rem; }
table { border-collapse: collapse; font-size: .92rem; font-variant-numeric: tabular-nums; }
th, td { text-align: left; padding: .28rem 1.4rem .28rem 0; border-bottom: 1px solid var(--line);
  vertical-align: top; }
td { overflow-wrap: anywhere; }
tr:last-child > * { border-bottom: 0; }
th { font-weight: 500; color: var(--soft); white-space: nowrap; }
.wide { overflow-x: auto; }
td.number, th.number { text-align: right; }
.bar { display: inline-block; height: .6em; border-radius: 2px; background: var(--accent);
  opacity: .75; vertical-align: baseline; }
pre { background: #f3f5f7; border-radius: 6px; padding: .7rem .9rem; margin: 0; overflow-x: auto;
  font: .88rem/1.5 ui-monospace, "DejaVu Sans Mono", Menlo, Consolas, monospace; }
.columns { display: grid; grid-template-columns: repeat(auto-fit, minmax(330px, 1fr));
  gap: 0 2.4rem; margin-bottom: 1rem; }
.good { border-left: 8px solid #009e73; }
.doubtful { border-left: 8px solid #e69f00; background: #fff8e8; }
.failed { border-left: 8px solid #d55e00; background: #fdeee6; }
footer { color: var(--soft); font-size: .85rem; }
@media print { body { background: #fff; } section, .card { break-inside: avoid; } }
"""


def page(title: str, subtitle: str, body: Iterable[str], footer: str) -> str:
    """Whole page; `body` is HTML, the rest is text."""
    return (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{escape(title)}</title>\n<style>{_CSS}</style>\n</head>\n<body>\n<main>\n"
        f"<header><h1>{escape(title)}</h1>\n<p>{escape(subtitle)}</p></header>\n"
        + "\n".join(body)
        + f"\n<footer>{escape(footer)}</footer>\n</main>\n</body>\n</html>\n"
    )


def section(title: str, *body: str) -> str:
    """Box with a heading around HTML."""
    return f"<section>\n<h2>{escape(title)}</h2>\n" + "\n".join(body) + "\n</section>"


def paragraph(text: str) -> str:
    """Paragraph of text."""
    return f"<p>{escape(text)}</p>"


def figure(address: str, caption: str, alt: str) -> str:
    """Figure with its caption; `address` is that of an image."""
    return (
        f'<figure><img src="{address}" alt="{escape(alt)}">'
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


def banner(word: str, tone: str, lines: Iterable[str]) -> str:
    """Box in the colour of a verdict ("good", "doubtful", "failed") with lines of text."""
    told = "\n".join(paragraph(line) for line in lines)
    return f'<section class="{escape(tone)}"><h2>{escape(word)}</h2>\n{told}</section>'


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


def code(text: str) -> str:
    """Text as it would be typed."""
    return f"<pre>{escape(text)}</pre>"
