"""HTML pages of results: single files for screens, phones and print, readable offline."""

from __future__ import annotations

import html
import io
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from matplotlib.figure import Figure

#: Longest name in a figure [characters].
_MAX_LABEL_LENGTH = 48

#: CSS of every page.
STYLE_SHEET = """
:root { color-scheme: light dark; --ink: #1c1c1c; --paper: #ffffff; --line: #d0d0d0; --soft: #f4f4f4; }
@media (prefers-color-scheme: dark) {
  :root { --ink: #e8e8e8; --paper: #16181a; --line: #44484c; --soft: #22262a; }
  figure svg { background: #ffffff; border-radius: 4px; }
}
* { box-sizing: border-box; }
body { margin: 0 auto; max-width: 64rem; padding: 1rem; color: var(--ink); background: var(--paper);
       font: 1rem/1.5 system-ui, sans-serif; }
h1 { font-size: 1.6rem; margin: 0.5rem 0; } h2 { font-size: 1.2rem; margin: 2rem 0 0.5rem; }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; font-size: 0.9rem; font-variant-numeric: tabular-nums; }
th, td { border-bottom: 1px solid var(--line); padding: 0.25rem 0.6rem; text-align: right; white-space: nowrap; }
th:first-child, td:first-child { text-align: left; position: sticky; left: 0; background: var(--paper); }
th, td:first-child { white-space: normal; } td:first-child { min-width: 7rem; }
tbody tr:nth-child(even) td { background: var(--soft); }
small { opacity: 0.75; }
figure { margin: 0.5rem 0; } figure svg { width: 100%; height: auto; } figcaption { font-size: 0.9rem; }
pre { overflow-x: auto; background: var(--soft); padding: 0.6rem; border-radius: 4px; font-size: 0.85rem; }
p.warning, p.fine { border-left: 4px solid #c40; padding: 0.2rem 1rem; } p.fine { border-color: #084; }
@media print {
  :root { --ink: #000000; --paper: #ffffff; --soft: #ffffff; }
  body { max-width: none; font-size: 9pt; } .scroll { overflow: visible; } table { font-size: 7pt; }
  th, td { padding: 1pt 3pt; } h2, figure { break-inside: avoid; } h2 { break-after: avoid; }
}
"""


def html_document(title: str, elements: Sequence[str]) -> str:
    """A whole page from HTML elements."""
    return (
        f'<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        f'<meta name="viewport" content="width=device-width, initial-scale=1">\n<title>{html.escape(title)}</title>\n'
        f"<style>{STYLE_SHEET}</style>\n</head>\n<body>\n" + "\n".join(elements) + "\n</body>\n</html>\n"
    )


def html_table(headings: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A scrolling table, with headings as text and cells as HTML."""
    head = "".join(f"<th>{html.escape(text)}</th>" for text in headings)
    body = "\n".join("<tr>" + "".join(f"<td>{cell}</td>" for cell in row) + "</tr>" for row in rows)
    return f'<div class="scroll"><table>\n<thead><tr>{head}</tr></thead>\n<tbody>\n{body}\n</tbody>\n</table></div>'


def figure_label(text: str) -> str:
    """A name as literal and short text for matplotlib.

    Dollar signs start no formula, a leading underscore does not hide it from a legend, and a long name is shortened.
    """
    short = (
        text
        if len(text) <= _MAX_LABEL_LENGTH
        else f"{text[: _MAX_LABEL_LENGTH // 2]}…{text[-_MAX_LABEL_LENGTH // 2 :]}"
    )
    return (" " if short.startswith("_") else "") + short.replace("$", r"\$")


def figure_to_svg(figure: Figure) -> str:
    """A figure as an SVG element of the page."""
    from matplotlib import rc_context

    buffer = io.StringIO()
    # Text stays text for search and screen readers; ids do not depend on the clock.
    with rc_context({"svg.fonttype": "none", "svg.hashsalt": str(np.random.default_rng(0).integers(1 << 30))}):
        figure.savefig(buffer, format="svg", metadata={"Date": None, "Creator": None})
    text = buffer.getvalue()
    return text[text.index("<svg") :]
