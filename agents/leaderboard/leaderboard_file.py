"""Boards: files of what policies are worth by the protocol, a line of JSON for each entry."""

from __future__ import annotations

import html
import json
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from agents.console_output import check_output_file, check_output_folder, replace_non_finite
from agents.evaluation.comparison_tables import METRIC_COLUMNS, MetricColumn, center_value
from agents.evaluation.oracle import ORACLE_FOLDER
from agents.leaderboard.protocol import PROTOCOL_TRACKS, PROTOCOL_VERSION, SCORE_COLUMN, file_digest
from estimator.support.argument_checks import mask_control_codes
from estimator.support.file_io import append_atomically, check_readable_file, write_atomically

#: The board that ships with the package.
SHIPPED_LEADERBOARD = Path(__file__).parents[1] / "leaderboard.jsonl"

#: Where one's own entries go.
OWN_LEADERBOARD = Path("runs/leaderboard.jsonl")

_MAX_BYTES = 2**26  # bytes
_SHIFT_NAMES = ("parameters", "noises", "limits", "equation")

COLUMN_TITLES = (
    "", SCORE_COLUMN.title, "seeds", "budget", "information / nat", "covered / %", "ended early / %",
    *(f"{shift} / nat" for shift in _SHIFT_NAMES),
)  # fmt: skip


def check_new_entry(path: Path, name: str) -> set[str]:
    """The tracks that a board, which is to be added to, has this name on already, before the work begins.

    Raises:
        ValueError: as `read_entries`; or for a name of the board that ships, whose entry a report would show no longer.
        OSError: for a folder, a file where its folder is to be, or a place where nothing can be written.
    """
    check_output_folder("folder of board", path.parent)
    check_output_file("board", path)
    if path.resolve() != SHIPPED_LEADERBOARD.resolve() and name.strip() in {
        entry["name"].strip() for entry in read_entries(SHIPPED_LEADERBOARD)
    }:
        raise ValueError(
            f"submit must be a name of your own, but is {name}, which the board that ships has; name another"
        )
    return {str(entry["track"]) for entry in read_entries(path) if entry["name"] == name} if path.exists() else set()


def append_entry(path: Path, entry: dict[str, Any]) -> None:
    """Add an entry, in one piece, on a line of its own: an editor may have left the last one without its end.

    Raises:
        OSError: where it cannot be written.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    line = json.dumps(replace_non_finite(entry), ensure_ascii=False, allow_nan=False) + "\n"
    append_atomically(path, line if _ends_with_newline(path) else "\n" + line)


def _ends_with_newline(path: Path) -> bool:
    if not path.exists() or not path.stat().st_size:
        return True
    with path.open("rb") as file:
        file.seek(-1, os.SEEK_END)
        return file.read() == b"\n"


def read_entries(path: Path) -> list[dict[str, Any]]:
    """The entries of this version of the protocol; of one name on one track the latest.

    Raises:
        ValueError: for a line that is not an entry, saying which.
        FileNotFoundError: if there is no such file.
    """
    text = check_readable_file(path, "board must be a file of entries", _MAX_BYTES).read_text(
        encoding="utf-8", errors="replace"
    )
    entries: dict[tuple[str, str], dict[str, Any]] = {}
    for number, line in enumerate(text.splitlines(), start=1):
        if not line.strip():  # two programs that add at once may leave an empty one
            continue
        try:
            entry = json.loads(line)
            key = str(entry["track"]), str(entry["name"])
            _sort_key(entry), entry_cells(entry), _oracle_digest(entry)
        except Exception as error:  # whatever a file of somebody else's makes of what is shown
            raise ValueError(f"board must hold an entry a line, but {path}:{number} is not one: {error!r}") from error
        if entry.get("protocol") == PROTOCOL_VERSION:
            entries[key] = entry
    return list(entries.values())


def stored_oracle_digests() -> set[str]:
    """Digests of the oracles of this version."""
    return {file_digest(path) for path in ORACLE_FOLDER.glob("*.npz")}


def leaderboard_rows(entries: Sequence[dict[str, Any]]) -> dict[str, list[list[str]]]:
    """Rows under `COLUMN_TITLES` for each track, the best score first."""
    ordered = sorted(entries, key=_sort_key)
    current_oracles = stored_oracle_digests()
    rows: dict[str, list[list[str]]] = {track: [] for track in PROTOCOL_TRACKS}
    for entry in ordered:
        name, score, *others = entry_cells(entry)
        outdated_mark = "" if _oracle_digest(entry) in current_oracles else " *"
        rows.setdefault(str(entry["track"]), []).append([name, score + outdated_mark, *others])
    return {track: found for track, found in rows.items() if found}


def _sort_key(entry: dict[str, Any]) -> float:
    return float(-entry["score"]["iqm"])


def _oracle_digest(entry: dict[str, Any]) -> str:
    return str(entry["reference"]["oracle"])


def entry_cells(entry: dict[str, Any]) -> list[str]:
    """The row of an entry."""
    metrics = entry["metrics"]
    shifted = [entry["shifted"].get(shift, {}).get("fisher_gain") for shift in _SHIFT_NAMES]
    return [
        mask_control_codes(str(entry["name"])),
        f"{_format_center(SCORE_COLUMN, entry['score'])} [{', '.join(SCORE_COLUMN.format_value(entry['score'][end]) for end in ('low', 'high'))}]",
        str(entry["seeds"]),
        str(entry["budget"]),
        *(
            _format_center(METRIC_COLUMNS[name], metrics[name])
            for name in ("information_gain", "coverage", "ended_early")
        ),
        *(_format_center(METRIC_COLUMNS["fisher_gain"], found) for found in shifted),
    ]


def write_leaderboard_page(path: Path, entries: Sequence[dict[str, Any]]) -> None:
    """Write a page of the boards, which opens without a network."""
    from estimator.support.html_page import html_document, html_table

    parts = ["<h1>Leaderboard</h1>", f"<p>{LEADERBOARD_CAPTION}</p>"]
    for track, rows in leaderboard_rows(entries).items():
        escaped_rows = [[html.escape(cell) for cell in row] for row in rows]
        parts += [f"<h2>{html.escape(track)}</h2>", html_table(COLUMN_TITLES, escaped_rows)]
    write_atomically(path, html_document("Leaderboard", parts))


LEADERBOARD_CAPTION = (
    "Score: interquartile mean over seeds and systems of the D-efficiency, against the certified optimum of each "
    "system that has one and else the best input that is known, with its 95 % bootstrap interval over systems. The "
    "others are means over 256 systems: information gained, 90 % intervals that cover, episodes that a limit ended, "
    "and the Fisher information on systems whose parameters, noises, limits or equation are shifted. Budget: samples "
    "of training (none: it learns nothing; open: more than 10 million). A star marks a score against an earlier oracle."
)


def _format_center(metric: MetricColumn, entry: dict[str, Any] | None) -> str:
    center = None if entry is None else center_value(entry)
    return "-" if center is None else metric.format_value(center)
