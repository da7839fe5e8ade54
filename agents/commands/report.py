"""``duffing-env report``: boards as tables, and as a page."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Report:
    """Show the leaderboard that ships, with your own entries.

    $ duffing-env report
    $ duffing-env report --board runs/leaderboard.jsonl --output board.html
    """

    board: Path | None = None
    """File of your own entries; runs/leaderboard.jsonl where there is one."""
    output: Path | None = None
    """Write a page here, which opens without a network."""

    def run(self) -> None:
        """Print the tables, and write the page."""
        from agents.cli import check_outputs
        from agents.evaluation import board
        from agents.results import show, table

        check_outputs({"output": self.output}, [self.board or board.OWN])
        own = self.board if self.board is not None else board.OWN if board.OWN.is_file() else None
        entries = {(e["track"], e["name"]): e for path in (board.SHIPPED, own) if path for e in board.read(path)}
        # What is printed needs no file, and comes also where none can be written.
        try:
            if self.output is not None:
                board.write_page(self.output, list(entries.values()))
        finally:
            for track, rows in board.tables(list(entries.values())).items():
                show(f"\n{track}", table(board.TITLES, rows))
            show(board.CAPTION)
        if self.output is not None:
            show(f"The page is {self.output}")
