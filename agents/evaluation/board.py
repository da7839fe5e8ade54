"""Boards: files of what policies are worth by the protocol, a line of JSON for each entry."""

from __future__ import annotations

import html
import json
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from agents.evaluation.leaderboard import METRICS, Metric, center_of
from agents.evaluation.oracle import FOLDER
from agents.evaluation.protocol import SCORE, TRACKS, VERSION, digest
from agents.results import check_file, check_folder, finite
from estimator.checks import printable
from estimator.files import append_atomically, whole_file, write_atomically

#: The board that ships with the package.
SHIPPED = Path(__file__).parents[1] / "leaderboard.jsonl"

#: Where one's own entries go.
OWN = Path("runs/leaderboard.jsonl")

_LARGEST = 2**26  # bytes
_SHIFTS = ("parameters", "noises", "limits", "equation")

TITLES = (
    "", SCORE.title, "seeds", "budget", "information / nat", "covered / %", "ended early / %",
    *(f"{shift} / nat" for shift in _SHIFTS),
)  # fmt: skip


def check(path: Path, name: str) -> set[str]:
    """The tracks that a board, which is to be added to, has this name on already, before the work begins.

    Raises:
        ValueError: as `read`; or for a name of the board that ships, whose entry a report would show no longer.
        OSError: for a folder, a file where its folder is to be, or a place where nothing can be written.
    """
    check_folder("folder of board", path.parent)
    check_file("board", path)
    if path.resolve() != SHIPPED.resolve() and name.strip() in {entry["name"].strip() for entry in read(SHIPPED)}:
        raise ValueError(
            f"submit must be a name of your own, but is {name}, which the board that ships has; name another"
        )
    return {str(entry["track"]) for entry in read(path) if entry["name"] == name} if path.exists() else set()


def append(path: Path, entry: dict[str, Any]) -> None:
    """Add an entry, in one piece, on a line of its own: an editor may have left the last one without its end.

    Raises:
        OSError: where it cannot be written.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    line = json.dumps(finite(entry), ensure_ascii=False, allow_nan=False) + "\n"
    append_atomically(path, line if _ends_a_line(path) else "\n" + line)


def _ends_a_line(path: Path) -> bool:
    if not path.exists() or not path.stat().st_size:
        return True
    with path.open("rb") as file:
        file.seek(-1, os.SEEK_END)
        return file.read() == b"\n"


def read(path: Path) -> list[dict[str, Any]]:
    """The entries of this version of the protocol; of one name on one track the latest.

    Raises:
        ValueError: for a line that is not an entry, saying which.
        FileNotFoundError: if there is no such file.
    """
    text = whole_file(path, "board must be a file of entries", _LARGEST).read_text(encoding="utf-8", errors="replace")
    found: dict[tuple[str, str], dict[str, Any]] = {}
    for number, line in enumerate(text.splitlines(), start=1):
        if not line.strip():  # two programs that add at once may leave an empty one
            continue
        try:
            entry = json.loads(line)
            key = str(entry["track"]), str(entry["name"])
            _rank(entry), cells(entry), _oracle(entry)
        except Exception as error:  # whatever a file of somebody else's makes of what is shown
            raise ValueError(f"board must hold an entry a line, but {path}:{number} is not one: {error!r}") from error
        if entry.get("protocol") == VERSION:
            found[key] = entry
    return list(found.values())


def stored_oracles() -> set[str]:
    """Digests of the oracles of this version."""
    return {digest(path) for path in FOLDER.glob("*.npz")}


def tables(entries: Sequence[dict[str, Any]]) -> dict[str, list[list[str]]]:
    """Rows under `TITLES` for each track, the best score first."""
    ordered = sorted(entries, key=_rank)
    present = stored_oracles()
    rows: dict[str, list[list[str]]] = {track: [] for track in TRACKS}
    for entry in ordered:
        name, score, *others = cells(entry)
        earlier = "" if _oracle(entry) in present else " *"
        rows.setdefault(str(entry["track"]), []).append([name, score + earlier, *others])
    return {track: found for track, found in rows.items() if found}


def _rank(entry: dict[str, Any]) -> float:
    return float(-entry["score"]["iqm"])


def _oracle(entry: dict[str, Any]) -> str:
    return str(entry["reference"]["oracle"])


def cells(entry: dict[str, Any]) -> list[str]:
    """The row of an entry."""
    told = entry["metrics"]
    shifted = [entry["shifted"].get(shift, {}).get("fisher_gain") for shift in _SHIFTS]
    return [
        printable(str(entry["name"])),
        f"{_center(SCORE, entry['score'])} [{', '.join(SCORE.text(entry['score'][end]) for end in ('low', 'high'))}]",
        str(entry["seeds"]),
        str(entry["budget"]),
        *(_center(METRICS[name], told[name]) for name in ("information_gain", "coverage", "ended_early")),
        *(_center(METRICS["fisher_gain"], found) for found in shifted),
    ]


def write_page(path: Path, entries: Sequence[dict[str, Any]]) -> None:
    """Write a page of the boards, which opens without a network."""
    from estimator.page import page, table

    parts = ["<h1>Leaderboard</h1>", f"<p>{CAPTION}</p>"]
    for track, rows in tables(entries).items():
        told = [[html.escape(cell) for cell in row] for row in rows]
        parts += [f"<h2>{html.escape(track)}</h2>", table(TITLES, told)]
    write_atomically(path, page("Leaderboard", parts))


CAPTION = (
    "Score: interquartile mean over seeds and systems of the D-efficiency, against the certified optimum of each "
    "system that has one and else the best input that is known, with its 95 % bootstrap interval over systems. The "
    "others are means over 256 systems: information gained, 90 % intervals that cover, episodes that a limit ended, "
    "and the Fisher information on systems whose parameters, noises, limits or equation are shifted. Budget: samples "
    "of training (none: it learns nothing; open: more than 10 million). A star marks a score against an earlier oracle."
)


def _center(metric: Metric, entry: dict[str, Any] | None) -> str:
    center = None if entry is None else center_of(entry)
    return "-" if center is None else metric.text(center)
