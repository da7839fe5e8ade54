"""HTML report of a comparison of policies: a single file, which opens without a network, on a phone and in print."""

from __future__ import annotations

import html
import json
from collections.abc import Sequence
from pathlib import Path

from agents.evaluation.comparison_tables import (
    AUDITOR_EXPLANATION,
    ComparisonSettings,
    comparison_table,
    policy_by_estimator_table,
    table_caption,
)
from agents.evaluation.figures import (
    plot_calibration,
    plot_error_against_information,
    plot_inputs_and_outputs,
    plot_log_posterior_gain,
)
from agents.evaluation.policy_rollout import Evaluation
from agents.result_files import package_versions
from estimator.support.file_io import write_atomically
from estimator.support.html_page import figure_to_svg, html_document, html_table


def write_html_report(
    path: Path, evaluations: list[Evaluation], settings: ComparisonSettings, command: Sequence[str]
) -> None:
    """Write the report, in one piece.

    Args:
        path: of the HTML file.
        evaluations: at least one.
        settings: of the comparison.
        command: words of the command line.
    """
    title = f"{settings.env}: {', '.join(evaluation.title for evaluation in evaluations)}"
    figures = [
        (
            "Posterior contraction",
            plot_log_posterior_gain(evaluations),
            "Gain of the posterior's log density at the truth: median over systems, band from 25 to 75 %.",
        ),
        (
            "The chosen inputs",
            plot_inputs_and_outputs(evaluations),
            "Input and output of the first system in time, and the inputs' mean spectrum over systems.",
        ),
        (
            "Error against information",
            plot_error_against_information(evaluations),
            "Each point is a system. The Fisher information of an input at the truth bounds the error from below; "
            "an estimator far above the others loses information.",
        ),
        (
            "Calibration",
            plot_calibration(evaluations),
            "Proportion of intervals that hold the truth, against their nominal level; a calibrated posterior lies on "
            "the line, an over-confident one below it.",
        ),
    ]
    headings, rows = comparison_table(evaluations)
    parts = [
        f"<h1>{html.escape(settings.env)}</h1>",
        f"<p>{settings.systems} systems, seed {settings.seed}, the same for every policy; "
        f"options <code>{html.escape(json.dumps(settings.options))}</code>.</p>",
        "<h2>Leaderboard</h2>",
        html_table(headings, [[title, *map(_html_metric_cell, cells)] for title, *cells in rows]),
        f"<p><small>{_lines_to_sentences(table_caption(evaluations))} An episode that a limit ends counts with its "
        "last belief.</small></p>",
        _estimator_section(evaluations),
    ]
    for heading, figure, caption in figures:
        if figure is not None:
            parts.append(
                f"<h2>{heading}</h2><figure>{figure_to_svg(figure)}<figcaption>{caption}</figcaption></figure>"
            )
    version_list = ", ".join(f"{name} {number}" for name, number in package_versions().items())
    parts += [
        "<h2>How this page was made</h2>",
        f"<pre>{html.escape(' '.join(command))}</pre>",
        f"<p><small>{html.escape(version_list)}. "
        '<a href="evaluation.json">evaluation.json</a> beside this page holds all figures.</small></p>',
    ]
    write_atomically(path, html_document(title, parts))


def _lines_to_sentences(lines: str) -> str:
    """Lines as sentences."""
    return " ".join(f"{html.escape(line[:1].upper() + line[1:])}." for line in lines.splitlines())


def _html_metric_cell(cell: str) -> str:
    """A cell of the table as HTML, with the interval in small letters below the centre."""
    center, _, below = cell.partition("\n")
    return f"{center}<br><small>{below.replace(chr(10), '<br>')}</small>"


def _estimator_section(evaluations: list[Evaluation]) -> str:
    """The table of policies by estimators; empty where there are no other estimators."""
    headings, rows = policy_by_estimator_table(evaluations)
    if not rows:
        return ""
    return (
        "<h2>Other estimators on the same inputs and outputs</h2>"
        f"<p>{_lines_to_sentences(AUDITOR_EXPLANATION)} It ranks the inputs; the rows of one policy rank the "
        "estimators.</p>" + html_table(headings, [[html.escape(cell) for cell in row] for row in rows])
    )
