"""What follows a training from within Stable-Baselines3: its loop's callback, and its log."""

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

from estimator.files import writing

_STEPS = "time/total_timesteps"


class Watch(BaseCallback):
    """Reports every roll-out, and every update that follows one.

    Args:
        on_rollout: called with the samples so far and the mean return of the last episodes, before the update.
        on_update: called after the update.
        on_step: called with the samples so far, after every step of the environments.
        entropy_bonus: of the algorithm at the start, where it is to fall linearly to 0; 0 leaves it as it is.
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
        self._report, self._updated, self._stepped = on_rollout, on_update, on_step
        self._collected = False

    def _on_step(self) -> bool:
        self._stepped(self.num_timesteps)
        return True

    def _on_rollout_end(self) -> None:
        episodes: Any = self.model.ep_info_buffer or []
        self._report(
            self.num_timesteps, float(np.mean([episode["r"] for episode in episodes])) if episodes else float("nan")
        )
        self._collected = True
        if self._entropy_bonus:
            model: Any = self.model
            model.ent_coef = self._entropy_bonus * model._current_progress_remaining

    def _on_rollout_start(self) -> None:
        if self._collected:
            self._updated()

    def _on_training_end(self) -> None:
        self._updated()


class Log(Logger):
    """Stable-Baselines3's log, with seconds of the clock that nobody sets, in place of its own.

    Args:
        folder: of the files.
        formats: that write them.
        steps: samples that the training goes on from.
    """

    def __init__(self, folder: Path, formats: list[Any], steps: int) -> None:
        super().__init__(str(folder), formats)
        self._began, self._steps = time.perf_counter(), steps

    def dump(self, step: int = 0) -> None:
        """Write what was recorded."""
        if "time/time_elapsed" in self.name_to_value:
            seconds = max(time.perf_counter() - self._began, 1e-9)
            self.name_to_value["time/time_elapsed"] = int(seconds)
            self.name_to_value["time/fps"] = int((step - self._steps) / seconds)
        super().dump(step)


class Board(TensorBoardOutputFormat):
    """TensorBoard's log; an error names its folder."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        with writing(folder):
            super().__init__(str(folder))

    def write(self, *row: Any) -> None:
        """Write a row."""
        with writing(self._folder):
            super().write(*row)

    def close(self) -> None:
        """Write what is left."""
        with writing(self._folder):
            super().close()


class ContinuedCSV(CSVOutputFormat):
    """A log that goes on after its rows up to ``steps``; what is there already is never lost, as it replaces the file.

    Args:
        path: of the CSV file; it need not exist.
        steps: samples that the training goes on from.

    Raises:
        OSError: naming the file, where it cannot be written, as `write` and `close`.
    """

    def __init__(self, path: Path, steps: int) -> None:
        self._path = path
        before = path.read_text(encoding="utf-8").splitlines() if path.exists() else []
        kept = before[:1] + [line for line in before[1:] if _logged_by(before[0], line, steps)]
        replacement = path.with_name(f".{path.name}")
        try:
            with writing(path):
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
        with writing(self._path):
            super().write(*row)

    def close(self) -> None:
        """Close the file."""
        with writing(self._path):
            super().close()


def _logged_by(head: str, line: str, steps: int) -> bool:
    """Whether a row is whole, and of a sample up to ``steps``."""
    (row,) = csv.DictReader([head, line])
    return None not in row.values() and None not in row and int(row[_STEPS] or steps + 1) <= steps
