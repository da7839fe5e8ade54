"""``duffing-env design``: the next experiment on a rig, as a signal."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro


@dataclass(frozen=True)
class DesignCommand:
    """Design the next experiment: a signal within the rig's limits, and the intervals to be expected after it.

    $ duffing-env design rig.toml
    $ duffing-env design rig.toml posterior.npz -o next.csv --figure next.png
    $ duffing-env design rig.toml posterior.npz --policy prbs -o next.csv
    """

    rig: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="RIG")]
    """Rig file, with input.limit and output.range, or the name of a rig that ships."""
    posterior: Annotated[Path | None, tyro.conf.Positional, tyro.conf.arg(metavar="[POSTERIOR]")] = None
    """What is known: a file of identify --save, or estimator.npz of a run. The rig's guess if there is none."""
    policy: str = "efe"
    """The planner, a signal, or a policy that ships."""
    samples: int = 256
    """Of the experiment."""
    bound: float = 0.05
    """Largest probability that the output leaves its range, under all that is believed."""
    seed: int = 0
    """Of the policy, and of the systems that are drawn from what is believed."""
    output: Annotated[Path | None, tyro.conf.arg(aliases=["-o"], metavar="PATH")] = None
    """CSV file for the signal, in the rig's units."""
    figure: Annotated[Path | None, tyro.conf.arg(metavar="PATH")] = None
    """Picture (PNG) of the signal, and of what the sensor is expected to show."""
    force: bool = False
    """Replace the files where there are some."""

    def run(self) -> None:
        """Design, print what is to be expected, and write the signal."""
        from agents.console_output import print_wrapped
        from agents.hardware.next_experiment import design_experiment
        from agents.output_paths import check_distinct_files, check_not_overwritten
        from estimator.saving import load_estimator
        from estimator.support.optional_dependencies import require_packages
        from estimator.support.progress import show_progress

        check_distinct_files(
            {"output": self.output, "figure": self.figure}, [self.rig, *filter(None, [self.posterior])]
        )
        check_not_overwritten("output", self.output, self.force)
        check_not_overwritten("figure", self.figure, self.force)
        if self.figure is not None:
            require_packages("matplotlib")
            if self.figure.suffix.lower() != ".png":
                raise ValueError(f"figure must be a PNG file, but is {self.figure}; let its name end in .png")
        prior = None if self.posterior is None else load_estimator(self.posterior).belief
        with show_progress("Designing") as on_progress:
            experiment_design = design_experiment(
                self.rig, prior, self.policy, self.samples, self.bound, self.seed, on_progress
            )
        # What is printed needs no file, and comes also where none can be written.
        try:
            if self.output is not None:
                experiment_design.write(self.output)
            if self.figure is not None:
                from agents.evaluation.figures import plot_experiment_design, save_png

                save_png(plot_experiment_design(experiment_design), self.figure)
        finally:
            print_experiment_design(experiment_design)
        if self.output is not None:
            print_wrapped(f"The signal is {self.output}")
        if self.figure is not None:
            print_wrapped(f"The picture is {self.figure}")


def print_experiment_design(experiment_design: Any) -> None:
    """Print the intervals before and after, and how safe the signal is."""
    from agents.console_output import format_table, print_warning
    from agents.console_output import print_texts_and_tables as print_all
    from agents.hardware.next_experiment import undersampling_message
    from estimator.identification.diagnostics.record_checks import MIN_SAMPLES_PER_PERIOD
    from estimator.rigs.units import digits_to_distinguish

    # A mean that differs from 0 by rounding alone is 0.
    rows = [
        [
            name,
            f"{mean if abs(mean) > 1e-9 * (high - low) else 0.0:.{digits}g}",
            f"{low:.{digits}g} to {high:.{digits}g}",
            f"± {half_width:.2g}",
            f"{(high - low) / 2 / half_width:.3g}",
            unit,
        ]
        for name, mean, (low, high), half_width, unit in experiment_design.parameter_rows()
        for digits in [digits_to_distinguish(low, high, 5)]
    ]
    description = f"{len(experiment_design.u)} samples by {experiment_design.policy}, up to {abs(experiment_design.u).max():.3g} {experiment_design.rig.input.unit}"
    description += f", made smaller to {experiment_design.scale:.2g} of it" if experiment_design.scale < 1 else ""
    print_all(
        format_table(("", "mean", "90 % interval now", "expected after", "times narrower", "unit"), rows),
        f"{description}; {experiment_design.information_gain:.1f} nats more; out of the range with a probability of at most {experiment_design.exit_probability:.1g}.",
    )
    if len(set(experiment_design.u.tolist())) == 1 and experiment_design.scale > 0:
        message = f"every input is the same: {experiment_design.policy} holds its values for longer than {len(experiment_design.u)} samples here"
        print_warning(f"{message}; choose another signal, or more samples")
    if experiment_design.samples_per_period < MIN_SAMPLES_PER_PERIOD:
        print_warning(undersampling_message(experiment_design.rig.step, experiment_design.samples_per_period))
