"""Repeats the experiment of Kouw (2020) on the Silverbox record, or runs the Silverbox benchmark's official protocol.

python reproduce.py                     the paper's experiment, against its published numbers
python reproduce.py silverbox           the official protocol, for every estimator
python reproduce.py silverbox --select  other settings, compared without test data
"""

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import tyro

from agents.studies.kouw2020 import reproduce
from duffing_env.silverbox import RecordDamaged


@dataclass(frozen=True)
class Config:
    """Repeat the experiment of Kouw (2020) on the Silverbox record and compare with its published numbers.

    `reproduce.py silverbox` runs the Silverbox benchmark's official protocol instead.
    """

    json: Path | None = None
    """File for the results, machine-readable."""

    figures: Path = Path("runs/reproduction")
    """Folder for the paper's two figures of errors, as PNG."""

    data: Path | None = None
    """The record: SNLS80mV.csv or SNLS80mV.mat, or their folder. Searched for on this machine if not given."""

    def run(self) -> None:
        """Repeats the experiment."""
        reproduce(data=self.data, json=self.json, figures=self.figures)


@dataclass(frozen=True)
class Silverbox:
    """Run the official protocol of the Silverbox benchmark, for every estimator of this project.

    `python -m benchmarks.silverbox` puts other packages beside them.
    """

    json: Path | None = None
    """File for the results, machine-readable."""

    figures: Path = Path("runs/silverbox")
    """Folder for the figures of errors, learning and parameters, as PNG."""

    data: Path | None = None
    """The record: SNLS80mV.csv or SNLS80mV.mat, or their folder. Searched for on this machine if not given."""

    select: bool = False
    """Print what other settings give on the last quarter of the training section, and do nothing else."""

    def run(self) -> None:
        """Runs the protocol, or compares settings."""
        from agents.studies.silverbox_results import run_protocol
        from agents.studies.silverbox_selection import select

        if self.select:
            select(data=self.data)
        else:
            run_protocol(self.data, self.json, self.figures)


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command and returns its exit code: 2 where the record or a place for the results is no good."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    command: Config | Silverbox
    if words[:1] == ["silverbox"]:
        command = tyro.cli(Silverbox, args=words[1:], prog="reproduce.py silverbox")
    else:
        command = tyro.cli(Config, args=words)
    try:
        command.run()
    except (OSError, RecordDamaged) as error:  # RecordNotFound is an OSError
        print(error, file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
