"""One page that shows a comparison: a single HTML file, which opens without a network, on a phone and in print."""

from __future__ import annotations

import html
import io
import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from agents.evaluation.figures import (
    figure_of_calibration,
    figure_of_contraction,
    figure_of_information,
    figure_of_inputs,
)
from agents.evaluation.leaderboard import caption_of, leaderboard, two_way_table
from agents.evaluation.rollout import Evaluation
from agents.results import versions
from estimator.files import write_atomically

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_PACKAGES = ("duffing-env", "gymnasium", "numpy", "numba", "scipy")

_STYLE = """
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
@media print {
  :root { --ink: #000000; --paper: #ffffff; --soft: #ffffff; }
  body { max-width: none; font-size: 9pt; } .scroll { overflow: visible; } table { font-size: 7pt; }
  th, td { padding: 1pt 3pt; } h2, figure { break-inside: avoid; } h2 { break-after: avoid; }
}
"""


def write_report(path: Path, evaluations: list[Evaluation], settings: dict[str, Any], command: Sequence[str]) -> None:
    """Write the page, in one piece.

    Args:
        path: of the HTML file.
        evaluations: at least one.
        settings: of the comparison: ``env``, ``systems``, ``seed``, ``options``.
        command: the words of the command line that made it.
    """
    title = f"{settings['env']}: {', '.join(evaluation.title for evaluation in evaluations)}"
    figures = [
        (
            "Posterior contraction",
            figure_of_contraction(evaluations),
            "Gain of the posterior's log density at the truth: median over systems, band from 25 to 75 %.",
        ),
        (
            "The chosen inputs",
            figure_of_inputs(evaluations),
            "Input and output of the first system in time, and the inputs' mean spectrum over systems.",
        ),
        (
            "Error against information",
            figure_of_information(evaluations),
            "Each point is a system. What an input tells (Fisher information at the truth) bounds what can be known; "
            "an estimator that lies far above the others wastes it.",
        ),
        (
            "Calibration",
            figure_of_calibration(evaluations),
            "Share of intervals that hold the truth, against their nominal level; a calibrated posterior lies on the "
            "line, an over-confident one below it.",
        ),
    ]
    parts = [
        f"<h1>{html.escape(settings['env'])}</h1>",
        f"<p>{settings['systems']} systems, seed {settings['seed']}, the same for every policy; "
        f"options <code>{html.escape(json.dumps(settings['options']))}</code>.</p>",
        "<h2>Leaderboard</h2>",
        _leaderboard(evaluations),
        f"<p><small>{caption_of(evaluations).capitalize()}. An episode that a limit ends counts with what was known by "
        "then.</small></p>",
        _estimators(evaluations),
    ]
    for heading, figure, caption in figures:
        if figure is not None:
            parts.append(f"<h2>{heading}</h2><figure>{_svg(figure)}<figcaption>{caption}</figcaption></figure>")
    used = ", ".join(f"{name} {number}" for name, number in versions(*_PACKAGES).items())
    parts += [
        "<h2>How this page was made</h2>",
        f"<pre>{html.escape(' '.join(command))}</pre>",
        f"<p><small>{html.escape(used)}. "
        '<a href="evaluation.json">evaluation.json</a> beside this page holds all figures.</small></p>',
    ]
    page = (
        f'<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        f'<meta name="viewport" content="width=device-width, initial-scale=1">\n<title>{html.escape(title)}</title>\n'
        f"<style>{_STYLE}</style>\n</head>\n<body>\n" + "\n".join(parts) + "\n</body>\n</html>\n"
    )
    write_atomically(path, page)


def _leaderboard(evaluations: list[Evaluation]) -> str:
    """The table of all metrics, a column for each policy, the best first; intervals below the centres, and smaller."""
    heads, rows = leaderboard(evaluations)
    cells = [[title, *map(_with_interval, cells)] for title, *cells in rows]
    return _table(heads, cells)


def _with_interval(cell: str) -> str:
    center, _, below = cell.partition("\n")
    return f"{center}<br><small>{below.replace(chr(10), '<br>')}</small>"


def _estimators(evaluations: list[Evaluation]) -> str:
    """The two-way table, policies by estimators; nothing where there is one estimator only."""
    heads, rows = two_way_table(evaluations)
    if not rows:
        return ""
    return (
        "<h2>The same inputs and outputs in other hands</h2>"
        "<p>The auditor, an offline maximum a posteriori fit that knows the noises, ranks the inputs; the rows of one "
        "policy rank the estimators.</p>" + _table(heads, [[html.escape(cell) for cell in row] for row in rows])
    )


def _table(heads: list[str], rows: list[list[str]]) -> str:
    """A table of texts and of cells that are HTML already."""
    head = "".join(f"<th>{html.escape(text)}</th>" for text in heads)
    body = "\n".join("<tr>" + "".join(f"<td>{cell}</td>" for cell in row) + "</tr>" for row in rows)
    return f'<div class="scroll"><table>\n<thead><tr>{head}</tr></thead>\n<tbody>\n{body}\n</tbody>\n</table></div>'


def _svg(figure: Figure) -> str:
    """A figure as an element of the page."""
    from matplotlib import rc_context

    buffer = io.StringIO()
    # Text stays text, so that it can be searched and read aloud; ids do not depend on the clock.
    with rc_context({"svg.fonttype": "none", "svg.hashsalt": str(np.random.default_rng(0).integers(1 << 30))}):
        figure.savefig(buffer, format="svg", metadata={"Date": None, "Creator": None})
    text = buffer.getvalue()
    return text[text.index("<svg") :]
