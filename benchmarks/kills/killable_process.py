"""Processes that run a command line and can be killed; they are forked from one that has imported the packages."""

import multiprocessing
import os
import signal
import sys
from pathlib import Path
from typing import Any

from agents.cli import run_script

#: Modules that the process to fork from imports.
PRELOADED = (
    "torch", "stable_baselines3", "optuna", "matplotlib.figure", "duffing_env", "agents.commands.train_command",
    "agents.evaluation.comparison", "research.studies.ship_policy", "agents.hardware.experiment_run",
    "estimator.identification",
)  # fmt: skip


def started(folder: Path, words: list[str]) -> Any:
    """Run a command line in a folder and a process of its own; its output goes into a file beside the folder."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(list(PRELOADED))
    process = context.Process(target=_command, args=(folder, words))
    process.start()
    return process


def _command(folder: Path, words: list[str]) -> None:
    os.chdir(folder)
    with open(folder.parent / f"{folder.name}.log", "w") as log:
        os.dup2(log.fileno(), 1)
        os.dup2(log.fileno(), 2)
    signal.signal(signal.SIGINT, signal.default_int_handler)  # processes in the background ignore it by default
    sys.argv = ["duffing-env", *words]
    if words[0] == "ship":
        from agents import policies
        from research.studies import ship_policy

        policies.TRAINED = folder  # in place of the package's own folder
        sys.argv = words
        return run_script(ship_policy.ship_median, ship_policy.Config)
    from agents.commands import main as command

    command()
