"""``duffing-env design``: design the input signal of the next experiment on a rig."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

if TYPE_CHECKING:
    from agents.hardware.experiment_design import ExperimentDesign


@dataclass(frozen=True)
class DesignCommand:
    """Design the next experiment: a signal within the rig's limits, and the intervals expected after it.

    $ duffing-env design rig.toml
    $ duffing-env design rig.toml posterior.npz -o next.csv --figure next.png
    $ duffing-env design rig.toml posterior.npz --policy prbs -o next.csv
    """

    rig: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="RIG")]
    """Rig file, with input.limit and output.range, or the name of a rig that ships."""
    posterior: Annotated[Path | None, tyro.conf.Positional, tyro.conf.arg(metavar="[POSTERIOR]")] = None
    """Belief before: a file of identify --save, or estimator.npz of a run; by the rig's guess if not given."""
    policy: str = "efe"
    """efe (the planner), a signal, or a policy that ships."""
    samples: int = 256
    """Samples of the experiment."""
    bound: float = 0.05
    """Largest probability that the output leaves its range, under the belief."""
    seed: int = 0
    """Seed of the policy, and of the systems that are drawn from the belief."""
    output: Annotated[Path | None, tyro.conf.arg(aliases=["-o"], metavar="PATH")] = None
    """CSV file for the signal, in the rig's units."""
    figure: Annotated[Path | None, tyro.conf.arg(metavar="PATH")] = None
    """Picture (PNG) of the signal and of the predicted output."""
    force: bool = False
    """Replace existing files."""

    def run(self) -> None:
        """Design, print the expected intervals, and write the signal."""
        from agents.console_output import print_in_80_columns
        from agents.hardware.next_experiment import design_experiment
        from agents.output_paths import check_distinct_files, check_not_overwritten
        from estimator.saving import load_estimator
        from estimator.support.optional_dependencies import require_packages
        from estimator.support.progress import show_progress

        check_distinct_files(
            {"output": self.output, "figure": self.figure}, [self.rig, *filter(None, [self.posterior])]
        )
        check_not_overwritten("-o/--output", self.output, self.force)
        check_not_overwritten("--figure", self.figure, self.force)
        if self.figure is not None:
            require_packages("matplotlib")
            if self.figure.suffix.lower() != ".png":
                raise ValueError(f"figure must be a PNG file, but is {self.figure}; let its name end in .png")
        prior = None if self.posterior is None else load_estimator(self.posterior).belief
        with show_progress("Designing") as on_progress:
            experiment_design = design_experiment(
                self.rig, prior, self.policy, self.samples, self.bound, self.seed, on_progress
            )
        # The result is printed also where the files cannot be written.
        try:
            if self.output is not None:
                experiment_design.write(self.output)
            if self.figure is not None:
                from agents.evaluation.figures import plot_experiment_design, save_png

                save_png(plot_experiment_design(experiment_design), self.figure)
        finally:
            print_experiment_design(experiment_design)
        if self.output is not None:
            print_in_80_columns(f"The signal is {self.output}")
        if self.figure is not None:
            print_in_80_columns(f"The picture is {self.figure}")


def print_experiment_design(design: ExperimentDesign) -> None:
    """Print the intervals before and after, and the probability of leaving the range."""
    from agents.console_output import format_table, print_warning
    from agents.console_output import print_texts_and_tables as print_all
    from agents.hardware.next_experiment import undersampling_message
    from estimator.identification.diagnostics.record_checks import MIN_SAMPLES_PER_PERIOD
    from estimator.rigs.units import format_interval

    rows = []
    for row in design.parameter_rows():
        mean_text, low_text, high_text = format_interval(row.mean, *row.interval, 5)
        low, high = row.interval
        rows.append(
            [
                row.name,
                mean_text,
                f"{low_text} to {high_text}",
                f"± {row.expected_half_width:.2g}",
                f"{(high - low) / 2 / row.expected_half_width:.3g}",
                row.unit,
            ]
        )
    unit = design.rig.only_input.unit
    description = f"{len(design.u)} samples by {design.policy}, up to {abs(design.u).max():.3g} {unit}"
    description += f", scaled by {design.scale:.2g} to be safe" if design.scale < 1 else ""
    print_all(
        format_table(("", "mean", "90 % interval now", "expected after", "times narrower", "unit"), rows),
        f"{description}; expected information gain {design.information_gain:.1f} nats; the output leaves its range "
        f"with a probability of at most {design.exit_probability:.1g}.",
    )
    if len(set(design.u.tolist())) == 1 and design.scale > 0:
        print_warning(
            f"every input is the same: {design.policy} holds its values for longer than {len(design.u)} samples "
            "here; choose another signal, or more samples"
        )
    if design.samples_per_period < MIN_SAMPLES_PER_PERIOD:
        print_warning(undersampling_message(design.rig.step, design.samples_per_period))
