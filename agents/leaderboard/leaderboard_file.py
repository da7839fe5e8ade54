"""Leaderboard files: entries of the evaluation protocol, a line of JSON each; checked, appended and read."""

from __future__ import annotations

import json
import os
from pathlib import Path

from agents.leaderboard.leaderboard_tables import entry_cells, oracle_digest_of, sort_key
from agents.leaderboard.protocol import PROTOCOL_VERSION, LeaderboardEntry
from agents.output_paths import check_output_file, check_output_folder
from agents.result_files import replace_non_finite
from estimator.support.file_io import append_atomically, check_readable_file

#: The leaderboard that comes with the package.
SHIPPED_LEADERBOARD = Path(__file__).parents[1] / "leaderboard.jsonl"

#: Default file of a user's own entries.
OWN_LEADERBOARD = Path("runs/leaderboard.jsonl")

#: Largest size of a leaderboard file [bytes].
_MAX_BYTES = 2**26


def check_new_entry(path: Path, name: str) -> set[str]:
    """Check, before a measurement, that an entry of this name can be added; returns the tracks that have one already.

    Raises:
        ValueError: as of `read_entries`; or for a name on the shipped leaderboard, whose entry a report would hide.
        OSError: for a folder, a file in place of its folder, or a path that cannot be written.
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


def append_entry(path: Path, entry: LeaderboardEntry) -> None:
    """Append an entry in one piece, on a line of its own also where the last line of the file has no end.

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


def read_entries(path: Path) -> list[LeaderboardEntry]:
    """The entries of this version of the protocol; for one name on one track, the latest.

    Raises:
        ValueError: for a line that is no entry, with its number.
        FileNotFoundError: if there is no such file.
    """
    text = check_readable_file(path, "board must be a file of entries", _MAX_BYTES).read_text(
        encoding="utf-8", errors="replace"
    )
    entries: dict[tuple[str, str], LeaderboardEntry] = {}
    for number, line in enumerate(text.splitlines(), start=1):
        if not line.strip():  # two programs that append at once may leave an empty line
            continue
        try:
            entry: LeaderboardEntry = json.loads(line)
            key = str(entry["track"]), str(entry["name"])
            sort_key(entry), entry_cells(entry), oracle_digest_of(entry)
        except Exception as error:  # any error of the tables on another user's file
            raise ValueError(f"board must hold an entry a line, but {path}:{number} is not one: {error!r}") from error
        if entry.get("protocol") == PROTOCOL_VERSION:
            entries[key] = entry
    return list(entries.values())
