"""Callback and logs of a training with Stable-Baselines3: progress.csv that can be resumed, and TensorBoard."""

from __future__ import annotations

import csv
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import CSVOutputFormat, Logger, TensorBoardOutputFormat

from estimator.support.file_io import explain_write_errors

#: Column of the samples so far, in progress.csv.
_STEPS_COLUMN = "time/total_timesteps"


class TrainingCallback(BaseCallback):
    """Calls functions after every step, every roll-out, and the update that follows it.

    Args:
        on_rollout: called with the samples so far and the mean return of the last episodes, before the update.
        on_update: called after the update.
        on_step: called with the samples so far, after every step of the environments.
        entropy_bonus: weight of the entropy at the start, which falls linearly to 0; 0: the algorithm's own weight.
    """

    def __init__(
        self,
        on_rollout: Callable[[int, float], None],
        on_update: Callable[[], None],
        on_step: Callable[[int], None],
        entropy_bonus: float = 0.0,
    ) -> None:
        super().__init__()
        self._entropy_bonus = entropy_bonus
        self._on_rollout_callback, self._on_update_callback, self._on_step_callback = on_rollout, on_update, on_step
        self._has_rollout = False

    def _on_step(self) -> bool:
        self._on_step_callback(self.num_timesteps)
        return True

    def _on_rollout_end(self) -> None:
        episodes: Any = self.model.ep_info_buffer or []
        self._on_rollout_callback(
            self.num_timesteps, float(np.mean([episode["r"] for episode in episodes])) if episodes else float("nan")
        )
        self._has_rollout = True
        if self._entropy_bonus:
            model: Any = self.model
            model.ent_coef = self._entropy_bonus * model._current_progress_remaining

    def _on_rollout_start(self) -> None:
        if self._has_rollout:
            self._on_update_callback()

    def _on_training_end(self) -> None:
        self._on_update_callback()


class WallTimeLogger(Logger):
    """Stable-Baselines3's logger with the seconds of a monotonic clock.

    Args:
        folder: of the files.
        formats: writers of the files.
        first_step: samples from which the training goes on.
    """

    def __init__(self, folder: Path, formats: list[Any], first_step: int) -> None:
        super().__init__(str(folder), formats)
        self._start_time, self._steps = time.perf_counter(), first_step

    def dump(self, step: int = 0) -> None:
        """Write the recorded values."""
        if "time/time_elapsed" in self.name_to_value:
            seconds = max(time.perf_counter() - self._start_time, 1e-9)
            self.name_to_value["time/time_elapsed"] = int(seconds)
            self.name_to_value["time/fps"] = int((step - self._steps) / seconds)
        super().dump(step)


class TensorBoardLog(TensorBoardOutputFormat):
    """TensorBoard's log; an error of the disk names its folder."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        with explain_write_errors(folder):
            super().__init__(str(folder))

    def write(self, *row: Any) -> None:
        """Write a row."""
        with explain_write_errors(self._folder):
            super().write(*row)

    def close(self) -> None:
        """Write the rest, and close."""
        with explain_write_errors(self._folder):
            super().close()


class ResumedCSVLog(CSVOutputFormat):
    """progress.csv with its rows up to ``first_step``, to which new rows are added; the file is replaced in one piece.

    Args:
        path: of the CSV file; it need not exist.
        first_step: samples from which the training goes on.

    Raises:
        OSError: naming the file, where it cannot be written, as of `write` and `close`.
    """

    def __init__(self, path: Path, first_step: int) -> None:
        self._path = path
        old_lines = path.read_text(encoding="utf-8").splitlines() if path.exists() else []
        kept = old_lines[:1] + [
            line for line in old_lines[1:] if _is_complete_row_until(old_lines[0], line, first_step)
        ]
        replacement = path.with_name(f".{path.name}")
        try:
            with explain_write_errors(path):
                super().__init__(str(replacement))
                if len(kept) > 1:
                    self.keys = kept[0].split(",")
                    self.file.write("".join(f"{line}\n" for line in kept))
                    self.file.flush()
                os.replace(replacement, path)
        finally:
            replacement.unlink(missing_ok=True)

    def write(self, *row: Any) -> None:
        """Write a row."""
        with explain_write_errors(self._path):
            super().write(*row)

    def close(self) -> None:
        """Close the file."""
        with explain_write_errors(self._path):
            super().close()


def _is_complete_row_until(header: str, line: str, steps: int) -> bool:
    """Whether a row is complete, and of at most this number of samples."""
    (row,) = csv.DictReader([header, line])
    return None not in row.values() and None not in row and int(row[_STEPS_COLUMN] or steps + 1) <= steps
