"""The leaderboard as tables: a row of texts for each entry, and an HTML page."""

from __future__ import annotations

import html
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from agents.evaluation.metric_summary import METRIC_COLUMNS, MetricColumn, MetricSummary, center_value
from agents.evaluation.oracle import ORACLE_FOLDER
from agents.leaderboard.protocol import PROTOCOL_TRACKS, SCORE_COLUMN, LeaderboardEntry, file_digest
from estimator.support.argument_checks import mask_control_codes
from estimator.support.file_io import write_atomically

#: Shifted test sets, in the order of the columns.
_SHIFT_NAMES = ("parameters", "noises", "limits", "equation")


#: Headings of a leaderboard.
COLUMN_TITLES = (
    "", SCORE_COLUMN.title, "seeds", "budget", "information / nat", "covered / %", "ended early / %",
    *(f"{shift} / nat" for shift in _SHIFT_NAMES),
)  # fmt: skip


def stored_oracle_digests() -> set[str]:
    """Digests of the oracles in this version of the package."""
    return {file_digest(path) for path in ORACLE_FOLDER.glob("*.npz")}


def leaderboard_rows(entries: Sequence[LeaderboardEntry]) -> dict[str, list[list[str]]]:
    """Track to its rows under `COLUMN_TITLES`, the best score first."""
    ordered = sorted(entries, key=sort_key)
    current_oracles = stored_oracle_digests()
    rows: dict[str, list[list[str]]] = {track: [] for track in PROTOCOL_TRACKS}
    for entry in ordered:
        name, score, *others = entry_cells(entry)
        outdated_mark = "" if oracle_digest_of(entry) in current_oracles else " *"
        rows.setdefault(str(entry["track"]), []).append([name, score + outdated_mark, *others])
    return {track: found for track, found in rows.items() if found}


def sort_key(entry: LeaderboardEntry) -> float:
    """Sorts the best score first."""
    return float(-entry["score"]["iqm"])


def oracle_digest_of(entry: LeaderboardEntry) -> str:
    """Digest of the oracle of an entry's score."""
    return str(entry["reference"]["oracle"])


def entry_cells(entry: LeaderboardEntry) -> list[str]:
    """The cells of an entry under `COLUMN_TITLES`."""
    metrics, score = entry["metrics"], entry["score"]
    shifted: list[Any] = [entry["shifted"].get(shift, {}).get("fisher_gain") for shift in _SHIFT_NAMES]
    low, high = (SCORE_COLUMN.format_value(end) for end in (score["low"], score["high"]))
    return [
        mask_control_codes(str(entry["name"])),
        f"{_format_center(SCORE_COLUMN, score)} [{low}, {high}]",
        str(entry["seeds"]),
        str(entry["budget"]),
        *(
            _format_center(METRIC_COLUMNS[name], metrics[name])
            for name in ("information_gain", "coverage", "ended_early")
        ),
        *(_format_center(METRIC_COLUMNS["fisher_gain"], found) for found in shifted),
    ]


def write_leaderboard_page(path: Path, entries: Sequence[LeaderboardEntry]) -> None:
    """Write a page of the leaderboards, which opens without a network."""
    from estimator.support.html_page import html_document, html_table

    parts = ["<h1>Leaderboard</h1>", f"<p>{LEADERBOARD_CAPTION}</p>"]
    for track, rows in leaderboard_rows(entries).items():
        escaped_rows = [[html.escape(cell) for cell in row] for row in rows]
        parts += [f"<h2>{html.escape(track)}</h2>", html_table(COLUMN_TITLES, escaped_rows)]
    write_atomically(path, html_document("Leaderboard", parts))


#: Explanation below a leaderboard.
LEADERBOARD_CAPTION = (
    "Score: interquartile mean over seeds and systems of the D-efficiency, relative to the certified optimum of each "
    "system or, where none is known, to the best known input, with its 95 % bootstrap interval over systems. The "
    "others are means over 256 systems: information gained, 90 % intervals that cover, episodes that a limit ended, "
    "and the Fisher information on systems whose parameters, noises, limits or equation are shifted. Budget: training "
    "samples (none: no training; open: more than 10 million). A star marks a score relative to an earlier oracle."
)


def _format_center(metric: MetricColumn, entry: MetricSummary | None) -> str:
    center = None if entry is None else center_value(entry)
    return "-" if center is None else metric.format_value(center)
