"""Repeats the experiment of Kouw (2020) on the Silverbox record: ``python reproduce.py --help``."""

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import tyro

from agents.reproduction import reproduce
from duffing_env.silverbox import RecordDamaged


@dataclass(frozen=True)
class Config:
    """Repeat the experiment of Kouw (2020) on the Silverbox record and compare with its published numbers."""

    json: Path | None = None
    """File for the results, machine-readable."""

    figures: Path = Path("runs/reproduction")
    """Folder for the paper's two figures of errors, as PNG."""

    data: Path | None = None
    """The record: SNLS80mV.csv or SNLS80mV.mat, or their folder. Searched for on this machine if not given."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command and returns its exit code: 2 where the record or a place for the results is no good."""
    config = tyro.cli(Config, args=arguments)
    try:
        reproduce(data=config.data, json=config.json, figures=config.figures)
    except (OSError, RecordDamaged) as error:  # RecordNotFound is an OSError
        print(error, file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
