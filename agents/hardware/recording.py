"""What a run writes, as it happens: a manifest, a row for every sample, a line for every event."""

from __future__ import annotations

import json
import math
import os
import subprocess
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from agents.console_output import check_output_folder, package_versions, replace_non_finite
from estimator.identification.data.column_names import name_with_unit
from estimator.rigs.rig import Rig
from estimator.support.file_io import append_atomically, explain_write_errors, lock_folder, write_atomically

#: Columns of samples.csv. `identify` takes ``time``, ``u`` and ``y``, which are called as the rig calls its columns.
#: ``time`` is that of the tick, ``clock`` the one when the row was complete; ``u`` the mean of the applied input until
#: the next tick, ``asked`` what was asked for; ``untimely`` an output that came too late to be used.
SAMPLE_COLUMNS = ("sample", "time", "u", "y", "asked", "block", "late", "clock", "untimely")


class Recording:
    """The folder of a run.

    - ``manifest.json``: what was to be done, with what; at the end also how it ended.
    - ``samples.csv``: a row for every sample, handed to the operating system before the next one: after a kill -9 at
      most the last is missing. A row without input and output is a pause of unknown length.
    - ``events.jsonl``: armed, disarmed, late samples, designs of blocks, what ended the run.

    Args:
        folder: is made; must be empty.
        manifest: what is to be kept about the run.
        rig: whose names of columns the samples have.

    Raises:
        ValueError: for a folder that holds something, or that another process writes to.
        NotADirectoryError: for a file, or a place in one.
    """

    def __init__(self, folder: str | Path, manifest: dict[str, Any], rig: Rig) -> None:
        self.folder = Path(folder)
        check_output_folder("out", self.folder)
        with explain_write_errors(self.folder):
            self.folder.mkdir(parents=True, exist_ok=True)
        self._folder_lock = lock_folder("out", self.folder)
        try:
            self._create_files(manifest, rig)
        except BaseException:
            self._release_lock()
            raise

    def _create_files(self, manifest: dict[str, Any], rig: Rig) -> None:
        if any(self.folder.iterdir()):
            raise ValueError(f"out must be a new or empty folder, but {self.folder} holds something; name another one")
        self._manifest = {
            **manifest,
            "versions": package_versions(),
            "commit": _git_commit(),
            "started": _utc_timestamp(),
            "ended": None,
        }
        self._write_manifest()
        names = {n: name_with_unit(one.column or n, one.unit) for n, one in (("u", rig.input), ("y", rig.output))}
        append_atomically(self.samples, ",".join(names.get(name, name) for name in SAMPLE_COLUMNS) + "\n")

    @property
    def samples(self) -> Path:
        """The file of the samples."""
        return self.folder / "samples.csv"

    def write_rows(self, rows: Sequence[Sequence[float | int | None]]) -> None:
        """Write rows, with a value or None for each of `SAMPLE_COLUMNS`."""
        lines = [
            ",".join("" if value is None or not math.isfinite(value) else repr(value) for value in row) for row in rows
        ]
        append_atomically(self.samples, "\n".join(lines) + "\n")

    def log_event(self, event: str, **details: Any) -> None:
        """Write a line about an event."""
        line = json.dumps(replace_non_finite({"time": _utc_timestamp(), "event": event, **details}))
        append_atomically(self.folder / "events.jsonl", line + "\n")

    def close(self, **outcome: Any) -> None:
        """Tell events and manifest how it ended; the samples become read-only."""
        try:
            self.log_event("ended", **outcome)
            self._manifest |= {**outcome, "ended": _utc_timestamp()}
            self._write_manifest()
            self.samples.chmod(0o444)
        finally:
            self._release_lock()

    def _release_lock(self) -> None:
        if self._folder_lock is not None:
            os.close(self._folder_lock)
            self._folder_lock = None

    def _write_manifest(self) -> None:
        write_atomically(self.folder / "manifest.json", json.dumps(replace_non_finite(self._manifest), indent=1) + "\n")


def _utc_timestamp() -> str:
    return datetime.now(UTC).isoformat(timespec="milliseconds")


def _git_commit() -> str | None:
    """Of the repository that the program lies in, if it does."""
    repository = Path(__file__).parents[2]
    if not (repository / ".git").exists():
        return None
    try:
        completed = subprocess.run(
            ["git", "rev-parse", "HEAD"], cwd=repository, capture_output=True, text=True, timeout=5
        )
    except (OSError, subprocess.TimeoutExpired):
        return None
    return completed.stdout.strip() or None
