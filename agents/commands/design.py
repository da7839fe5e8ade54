"""``duffing-env design``: the next experiment on a rig, as a signal."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro


@dataclass(frozen=True)
class Design:
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
        from agents.cli import check_new, check_outputs
        from agents.results import say
        from agents.running.experiment import design
        from estimator.extras import need
        from estimator.progress import progress
        from estimator.saving import load_estimator

        check_outputs({"output": self.output, "figure": self.figure}, [self.rig, *filter(None, [self.posterior])])
        check_new("output", self.output, self.force)
        check_new("figure", self.figure, self.force)
        if self.figure is not None:
            need("matplotlib")
            if self.figure.suffix.lower() != ".png":
                raise ValueError(f"figure must be a PNG file, but is {self.figure}; let its name end in .png")
        prior = None if self.posterior is None else load_estimator(self.posterior).belief
        with progress("Designing") as tell:
            found = design(self.rig, prior, self.policy, self.samples, self.bound, self.seed, tell)
        # What is printed needs no file, and comes also where none can be written.
        try:
            if self.output is not None:
                found.write(self.output)
            if self.figure is not None:
                from agents.evaluation.figures import figure_of_experiment, save

                save(figure_of_experiment(found), self.figure)
        finally:
            show(found)
        if self.output is not None:
            say(f"The signal is {self.output}")
        if self.figure is not None:
            say(f"The picture is {self.figure}")


def show(found: Any) -> None:
    """Print the intervals before and after, and how safe the signal is."""
    from agents.results import show as print_all
    from agents.results import table, warn
    from agents.running.experiment import too_slow
    from estimator.identification.checks import SLOWEST
    from estimator.units import digits_of

    # A mean that differs from 0 by rounding alone is 0.
    rows = [
        [
            name,
            f"{mean if abs(mean) > 1e-9 * (high - low) else 0.0:.{digits}g}",
            f"{low:.{digits}g} to {high:.{digits}g}",
            f"± {half:.2g}",
            f"{(high - low) / 2 / half:.3g}",
            unit,
        ]
        for name, mean, (low, high), half, unit in found.rows()
        for digits in [digits_of(low, high, 5)]
    ]
    made = f"{len(found.u)} samples by {found.policy}, up to {abs(found.u).max():.3g} {found.rig.input.unit}"
    made += f", made smaller to {found.share:.2g} of it" if found.share < 1 else ""
    print_all(
        table(("", "mean", "90 % interval now", "expected after", "times narrower", "unit"), rows),
        f"{made}; {found.gain:.1f} nats more; out of the range with a probability of at most {found.probability:.1g}.",
    )
    if len(set(found.u.tolist())) == 1 and found.share > 0:
        said = f"every input is the same: {found.policy} holds its values for longer than {len(found.u)} samples here"
        warn(f"{said}; choose another signal, or more samples")
    if found.samples_in_period < SLOWEST:
        warn(too_slow(found.rig.step, found.samples_in_period))
