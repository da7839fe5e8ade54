"""``duffing-env run``: run an experiment on a rig, and identify its parameters meanwhile."""

from __future__ import annotations

import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from agents.hardware.run_settings import RunSettings

if TYPE_CHECKING:
    from agents.hardware.experiment_run import RunResult


@dataclass(frozen=True)
class RunCommand:
    """Run an experiment on a rig, and identify while it goes on.

    The input is zero before and after, whatever happens. docs/running.md describes plants, and what can go wrong.

    $ duffing-env run rig.toml --plant agents.hardware.simulated_plant:plant --out run
    $ duffing-env run rig.toml --plant agents.hardware.visa_instrument:plant --out run
    $ duffing-env run rig.toml --plant lab:plant --block 64 --out run
    $ duffing-env run rig.toml run/estimator.npz --plant lab:plant --out next
    $ duffing-env identify rig.toml run/samples.csv
    """

    rig: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="RIG")]
    """Rig file, with input.limit and output.range, and a guess where there is no posterior."""
    plant: Annotated[str, tyro.conf.arg(metavar="MODULE:FACTORY")]
    """Factory of the plant: factory(rig, **instrument), with the table [instrument] of the rig file."""
    out: Annotated[Path, tyro.conf.arg(metavar="FOLDER")]
    """New folder for the samples and the manifest."""
    posterior: Annotated[Path | None, tyro.conf.Positional, tyro.conf.arg(metavar="[POSTERIOR]")] = None
    """Belief before: a file of identify --save, or estimator.npz of a run; by the rig's guess if not given."""
    plan: Annotated[RunSettings, tyro.conf.arg(name="")] = field(default_factory=RunSettings)
    """Settings of the run."""

    def run(self) -> None:
        """Run, and print the parameters; the exit status is `RunResult.exit_status`."""
        from agents.console_output import print_in_80_columns, print_warning
        from agents.hardware.experiment_run import NOT_ZEROED, run_experiment
        from agents.hardware.plant_interface import load_plant
        from estimator import Rig
        from estimator.saving import load_estimator
        from estimator.support.progress import show_progress

        rig, instrument = Rig.read_with_instrument(self.rig)
        prior = None if self.posterior is None else load_estimator(self.posterior).belief
        plant = load_plant(self.plant, rig, instrument)
        try:
            with show_progress("Running") as on_progress:
                report_samples = lambda samples_done: on_progress(samples_done / self.plan.samples, self.plan.policy)  # noqa: E731
                result = run_experiment(rig, plant, self.out, self.plan, prior=prior, on_progress=report_samples)
        finally:
            if hasattr(plant, "close"):
                plant.close()
        print_run_result(result)
        if result.outcome == NOT_ZEROED:
            print_in_80_columns(f"duffing-env: complete, but {result.message}", sys.stderr)
        elif result.exit_status:
            print_in_80_columns(f"duffing-env: ended early ({result.outcome}): {result.message}", sys.stderr)
        elif result.message:
            print_warning(result.message)
        sys.exit(result.exit_status)


def print_run_result(result: RunResult) -> None:
    """Print the parameters with their intervals, and the number of late ticks."""
    from agents.console_output import format_table
    from agents.console_output import print_texts_and_tables as print_all
    from estimator.rigs.units import format_interval

    intervals, units = result.interval(0.9), result.units
    rows = [
        [name, mean_text, f"{low_text} to {high_text}", units[name]]
        for name, (mean, _) in result.parameters.items()
        for mean_text, low_text, high_text in [format_interval(mean, intervals[name][0], intervals[name][1], 5)]
    ]
    late = (
        f"{result.late_ticks} ticks of the clock were missed"
        if result.late_ticks
        else "no tick of the clock was missed"
    )
    print_all(
        format_table(("", "mean", "90 % interval", "unit"), rows),
        f"{late}; the samples are {result.folder}/samples.csv",
    )
