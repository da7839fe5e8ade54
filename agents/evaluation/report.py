"""One page that shows a comparison: a single HTML file, which opens without a network, on a phone and in print."""

from __future__ import annotations

import html
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from agents.evaluation.figures import (
    figure_of_calibration,
    figure_of_contraction,
    figure_of_information,
    figure_of_inputs,
)
from agents.evaluation.leaderboard import AUDITOR_IS, caption_of, leaderboard, two_way_table
from agents.evaluation.rollout import Evaluation
from agents.results import versions
from estimator.files import write_atomically
from estimator.page import page, svg, table


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
    heads, rows = leaderboard(evaluations)
    parts = [
        f"<h1>{html.escape(settings['env'])}</h1>",
        f"<p>{settings['systems']} systems, seed {settings['seed']}, the same for every policy; "
        f"options <code>{html.escape(json.dumps(settings['options']))}</code>.</p>",
        "<h2>Leaderboard</h2>",
        table(heads, [[title, *map(_with_interval, cells)] for title, *cells in rows]),
        f"<p><small>{_sentences(caption_of(evaluations))} An episode that a limit ends counts with what was known by "
        "then.</small></p>",
        _estimators(evaluations),
    ]
    for heading, figure, caption in figures:
        if figure is not None:
            parts.append(f"<h2>{heading}</h2><figure>{svg(figure)}<figcaption>{caption}</figcaption></figure>")
    used = ", ".join(f"{name} {number}" for name, number in versions().items())
    parts += [
        "<h2>How this page was made</h2>",
        f"<pre>{html.escape(' '.join(command))}</pre>",
        f"<p><small>{html.escape(used)}. "
        '<a href="evaluation.json">evaluation.json</a> beside this page holds all figures.</small></p>',
    ]
    write_atomically(path, page(title, parts))


def _sentences(lines: str) -> str:
    """Lines as sentences."""
    return " ".join(f"{html.escape(line[:1].upper() + line[1:])}." for line in lines.splitlines())


def _with_interval(cell: str) -> str:
    """A cell of the leaderboard, whose interval stands smaller below the centre."""
    center, _, below = cell.partition("\n")
    return f"{center}<br><small>{below.replace(chr(10), '<br>')}</small>"


def _estimators(evaluations: list[Evaluation]) -> str:
    """The two-way table, policies by estimators; nothing where there is one estimator only."""
    heads, rows = two_way_table(evaluations)
    if not rows:
        return ""
    return (
        "<h2>What other estimators make of the same inputs and outputs</h2>"
        f"<p>{_sentences(AUDITOR_IS)} It ranks the inputs; the rows of one policy rank the estimators.</p>"
        + table(heads, [[html.escape(cell) for cell in row] for row in rows])
    )
