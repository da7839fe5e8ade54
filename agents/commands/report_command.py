"""``duffing-env report``: print the leaderboard, or write it as an HTML page."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class ReportCommand:
    """Show the leaderboard that ships, with your own entries.

    $ duffing-env report
    $ duffing-env report --board runs/leaderboard.jsonl --output board.html
    """

    board: Path | None = None
    """File of your own entries; runs/leaderboard.jsonl if it exists."""
    output: Path | None = None
    """File for a page, which opens without a network."""

    def run(self) -> None:
        """Print the tables, and write the page."""
        from agents.console_output import format_table, print_texts_and_tables
        from agents.leaderboard import leaderboard_file, leaderboard_tables
        from agents.output_paths import check_distinct_files

        check_distinct_files({"output": self.output}, [self.board or leaderboard_file.OWN_LEADERBOARD])
        own_leaderboard = self.board
        if own_leaderboard is None and leaderboard_file.OWN_LEADERBOARD.is_file():
            own_leaderboard = leaderboard_file.OWN_LEADERBOARD
        by_track_and_name = {
            (entry["track"], entry["name"]): entry
            for path in (leaderboard_file.SHIPPED_LEADERBOARD, own_leaderboard)
            if path
            for entry in leaderboard_file.read_entries(path)
        }
        entries = list(by_track_and_name.values())
        # The tables are printed also where the page cannot be written.
        try:
            if self.output is not None:
                leaderboard_tables.write_leaderboard_page(self.output, entries)
        finally:
            for track, rows in leaderboard_tables.leaderboard_rows(entries).items():
                print_texts_and_tables(f"\n{track}", format_table(leaderboard_tables.COLUMN_TITLES, rows))
            print_texts_and_tables(leaderboard_tables.LEADERBOARD_CAPTION)
        if self.output is not None:
            print_texts_and_tables(f"The page is {self.output}")
