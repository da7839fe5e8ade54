"""Repeat the experiment of Kouw (2020) on the Silverbox record, or run the official Silverbox benchmark protocol.

$ python reproduce.py                     the paper's experiment
$ python reproduce.py silverbox           the official protocol
$ python reproduce.py silverbox --select  compare settings, without test data
"""

import sys
from dataclasses import dataclass
from pathlib import Path

from agents.cli import run_script


@dataclass(frozen=True)
class Config:
    """Repeat the experiment of Kouw (2020) on the Silverbox record and compare with its published numbers."""

    json: Path | None = None
    """JSON file for the results."""
    figures: Path = Path("runs/reproduction")
    """Folder for the paper's two figures of errors (PNG)."""
    data: Path | None = None
    """SNLS80mV.csv or SNLS80mV.mat, or their folder; searched on this machine if not given."""


@dataclass(frozen=True)
class Silverbox(Config):
    """Run the official protocol of the Silverbox benchmark with every estimator of this project.

    `python -m benchmarks.silverbox_comparison` compares other packages.
    """

    figures: Path = Path("runs/silverbox")
    """Folder for the figures of errors, learning curves and parameters (PNG)."""
    select: bool = False
    """Only print the errors of other settings on the last quarter of the training section."""


def main(config: Config) -> None:
    """Repeat the experiment, run the protocol, or compare its settings."""
    from research.studies.kouw2020 import reproduce
    from research.studies.silverbox_results import compare_on_validation, run_protocol

    if not isinstance(config, Silverbox):
        reproduce(config.data, config.json, config.figures)
    elif config.select:
        compare_on_validation(config.data)
    else:
        run_protocol(config.data, config.json, config.figures)


if __name__ == "__main__":
    if sys.argv[1:2] == ["silverbox"]:
        del sys.argv[1]
        run_script(main, Silverbox, __doc__)
    else:
        run_script(main, Config, __doc__)
