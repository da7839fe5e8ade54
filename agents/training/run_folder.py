"""The folder of a training run: how it is created and locked, what it must not hold, and how a stopped run goes on."""

from __future__ import annotations

import shlex
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from agents.policies.networks.trained_policy import CARD_FILE, CONFIG_FILE
from agents.training.checkpoints import latest_checkpoint
from agents.training.hyperparameters import track_name
from agents.training.training_config import TrainConfig
from estimator.support.file_io import explain_write_errors, locked_folder

#: Picture of the returns in a run folder.
LEARNING_CURVE_FILE = "learning_curve.png"

#: Folder of the policy before its first update, in a run folder.
UNTRAINED_FOLDER = "untrained"


@contextmanager
def create_run_folder(config: TrainConfig) -> Iterator[Path]:
    """Create and lock the folder of a run; after an OSError without a checkpoint, its files are removed.

    Yields:
        ``config.output``; or runs/ALGO-TRACK-SEED, with a number where that folder exists.

    Raises:
        ValueError: for a folder that is neither new nor empty, or that another process trains in.
        OSError: naming the folder, where it cannot be made.
    """
    _check_run_folder(config)
    folder, created_parents = _make_folder(config)
    with locked_folder("output", folder):
        _check_run_folder(config)  # again: another process may have had the lock
        try:
            yield folder
        except OSError:
            if latest_checkpoint(folder) is None:
                for path in folder.iterdir():
                    shutil.rmtree(path) if path.is_dir() else path.unlink()
            raise
        finally:
            with suppress(OSError):  # a folder that is not empty stays
                for parent in created_parents:
                    parent.rmdir()


def _make_folder(config: TrainConfig) -> tuple[Path, list[Path]]:
    """Make the folder of a run; returns it and the folders that did not exist before, the innermost first."""
    base = Path("runs") / f"{config.algo}-{track_name(config.env).lower()}-{config.seed}"
    folder, number = config.output or base, 1
    created_parents = [place for place in (folder, *folder.parents) if not place.exists()]
    while True:
        with explain_write_errors(folder):
            try:
                folder.mkdir(parents=True, exist_ok=config.output is not None)
            except FileExistsError:
                number += 1
                folder = base.with_name(f"{base.name}-{number}")
                created_parents = [folder, *created_parents[1:]]
            else:
                return folder, created_parents


def _check_run_folder(config: TrainConfig) -> None:
    """Refuse a named folder that is neither new nor empty."""
    if config.output is None:
        return
    for content, name in (("run", CONFIG_FILE), ("policy", CARD_FILE)):
        if (config.output / name).exists():
            raise ValueError(
                f"output must be a new folder, but {config.output} holds a {content}; remove it or name another"
            )
    if config.output.is_dir() and (other := min((path.name for path in config.output.iterdir()), default="")):
        raise ValueError(
            f"output must be a new or empty folder, but {config.output} holds {other}, which is no training's; "
            "name another"
        )


def resume_hint(folder: Path) -> str:
    """How to go on with a training that is being stopped, by its latest checkpoint."""
    command = shlex.join(["duffing-env", "train", "--resume", str(folder)])
    if latest_checkpoint(folder) is not None:
        return f"go on with: {command}"
    return "nothing was kept" + (f"; begin again with: {command}" if (folder / CONFIG_FILE).exists() else "")
