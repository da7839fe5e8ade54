"""The files of a run, written as it happens: a manifest, a row for each sample, and a line for each event."""

from __future__ import annotations

import json
import math
import os
import subprocess
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np

from agents.hardware.plant_interface import InputValue
from agents.output_paths import check_output_folder
from agents.result_files import package_versions, replace_non_finite
from estimator.identification.data.column_units import name_with_unit
from estimator.rigs.rig import Rig
from estimator.support.file_io import append_atomically, explain_write_errors, lock_folder, write_atomically


class SampleRow(NamedTuple):
    """A row of samples.csv; None and NaN are written as nothing. `identify` reads ``time``, ``u`` and ``y``.

    Attributes:
        sample: number of the tick.
        time: of the tick [s].
        u: mean of the applied input until the next tick; its column has the name that the rig gives it. Several inputs
            (inputs,) have a column each.
        y: output at the tick; its column has the name that the rig gives it.
        commanded: the input that the policy chose, before clamps; several have the columns ``commanded_<input>``.
        block: number of the block; 0 in a run by samples.
        late: 1 where the tick was missed, or its output or input was late, else 0.
        clock: time when the row was complete [s].
        late_output: an output that came too late to be used.
    """

    sample: int
    time: float
    u: InputValue | None
    y: float | None
    commanded: InputValue | None
    block: int
    late: int
    clock: float
    late_output: float | None = None


class EventLog(Protocol):
    """Writes an event of a run."""

    def __call__(self, event: str, **details: object) -> None:
        """Write the event's name and its details."""


class Recording:
    """The folder of a run.

    - ``manifest.json``: command, rig, settings and plant of the run; at the end also how it ended.
    - ``samples.csv``: a row for each sample (`SampleRow`), handed to the operating system before the next one: after a
      kill -9 at most the last is missing. A row without input and output is a pause of unknown length.
    - ``events.jsonl``: armed, disarmed, late samples, designs of blocks, and the end of the run.

    Args:
        folder: a new folder, or an empty one.
        manifest: entries of manifest.json.
        rig: names the columns of inputs and output.

    Raises:
        ValueError: for a folder that is not empty, or that another process writes to.
        NotADirectoryError: for a file, or a path in a file.
    """

    def __init__(self, folder: str | Path, manifest: dict[str, object], rig: Rig) -> None:
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

    def _create_files(self, manifest: dict[str, object], rig: Rig) -> None:
        if any(self.folder.iterdir()):
            raise ValueError(f"out must be a new or empty folder, but {self.folder} holds something; name another one")
        self._manifest: dict[str, object] = {
            **manifest,
            "versions": package_versions(),
            "commit": _git_commit(),
            "started": _utc_timestamp(),
            "ended": None,
        }
        self._write_manifest()
        inputs = {name: name_with_unit(one.column or name, one.unit) for name, one in rig.inputs.items()}
        self._n_inputs = len(inputs)
        commanded = ["commanded"] if self._n_inputs == 1 else [f"commanded_{name}" for name in inputs]
        columns = {"u": [*inputs.values()], "y": [name_with_unit(rig.output.column or "y", rig.output.unit)]}
        columns["commanded"] = commanded
        names = [name for field in SampleRow._fields for name in columns.get(field, [field])]
        append_atomically(self.samples_path, ",".join(names) + "\n")

    @property
    def samples_path(self) -> Path:
        """The path of samples.csv."""
        return self.folder / "samples.csv"

    def write_rows(self, rows: Sequence[SampleRow]) -> None:
        """Append rows to samples.csv."""
        lines = []
        for row in rows:
            values = row if self._n_inputs == 1 else self._by_channel(row)
            lines.append(",".join("" if v is None or not math.isfinite(v) else repr(v) for v in values))
        append_atomically(self.samples_path, "\n".join(lines) + "\n")

    def _by_channel(self, row: SampleRow) -> list[Any]:
        """The values of a row of several inputs, one for each column."""
        values: list[Any] = []
        for field, value in zip(SampleRow._fields, row, strict=True):
            if field in ("u", "commanded"):
                values += [None] * self._n_inputs if value is None else np.asarray(value).tolist()
            else:
                values.append(value)
        return values

    def log_event(self, event: str, **details: object) -> None:
        """Append an event to events.jsonl (`EventLog`)."""
        line = json.dumps(replace_non_finite({"time": _utc_timestamp(), "event": event, **details}))
        append_atomically(self.folder / "events.jsonl", line + "\n")

    def close(self, *, how: str, message: str, late: int) -> None:
        """Write into events and manifest how the run ended; samples.csv becomes read-only.

        Args:
            how: outcome of the run.
            message: the reason, and warnings.
            late: number of late ticks.
        """
        outcome = {"how": how, "message": message, "late": late}
        try:
            self.log_event("ended", **outcome)
            self._manifest |= {**outcome, "ended": _utc_timestamp()}
            self._write_manifest()
            self.samples_path.chmod(0o444)
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
    """The commit of the repository that this file lies in; None where there is none."""
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
