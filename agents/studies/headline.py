"""The headline: what a chosen sample is worth in samples of the Silverbox regime, and what 256 of them identify.

    python -m agents.studies.headline

On common systems, each policy's information (½ log det(Λ0 + F) at the truth) is compared with that of the Silverbox
multisine regime over ever longer stretches: as recorded, and scaled so that its peak is the limit of the input. Under
the same peak that is Amplitude-v0, under the same power Power-v0, whose budget is the regime's own. The errors are
those of free runs of what 256 samples on the circuit's twin identified: over the real arrow record, and beside the
twin's own answer to its input.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from agents.cli import run_script
from agents.evaluation import metrics
from agents.evaluation.leaderboard import MEDIAN, METRICS, Metric, cell_of, center_and_interval, finite
from agents.evaluation.rollout import roll_out
from duffing_env.experiment import SimulatedExperiment
from duffing_env.silverbox import record_available, regime_input
from estimator import SILVERBOX_TWIN, difference
from estimator.files import write_atomically
from estimator.physical import coefficients_of

REGIME = "silverbox-multisine"

#: What is compared: the limit that both sides have, its track, and who chooses there.
COMPARISONS = {
    "equal peak": ("duffing_env/Amplitude-v0", ("ppo/amplitude", "efe")),
    "equal power": ("duffing_env/Power-v0", ("ppo/power", "efe")),
}

#: Longest stretch of the regime, log2 of its samples: once around.
_LONGEST = 16.5

#: Rows of the table.
ROWS = {
    "fisher_gain": METRICS["fisher_gain"],
    "worth_recorded": Metric("one sample, in samples of the regime", 1, center=MEDIAN),
    "worth_scaled": Metric("one sample, of the regime at that peak", 1, center=MEDIAN),
    "arrow_rmse": METRICS["arrow_rmse"],
    "twin_rmse": METRICS["simulation_rmse"],
}


@dataclass(frozen=True)
class Config:
    """Compare shipped policies with the Silverbox regime."""

    systems: int = 256
    """Systems, the same for all."""
    seed: int = 0
    """Seed of systems and noise."""
    json: Path = Path("runs/headline.json")
    """Where all numbers are written."""


def compare(track: str, names: tuple[str, ...], systems: int, seed: int) -> dict[str, dict[str, npt.NDArray[Any]]]:
    """Policies, and the regime itself, on one track: name to values (systems,) of what `ROWS` names."""
    peak = float(np.abs(regime_input("multisine", np.random.default_rng(seed))).max())
    told: dict[str, Any] = {}
    found = {}
    for name in (*names, REGIME):
        evaluation, _, truth, experiment = roll_out(name, track, systems, seed, {})
        assert isinstance(experiment, SimulatedExperiment)
        if not told:
            scales = {"worth_recorded": 1.0}
            if experiment.max_rms is None:  # at the peak that is allowed it would have more power than the budget
                scales["worth_scaled"] = experiment.max_input / peak
            for row, scale in scales.items():
                told[row] = metrics.regime_information(truth, experiment, seed, scale, _LONGEST)
        gains = metrics.information(evaluation.inputs, truth, experiment, evaluation.outputs)
        samples = np.count_nonzero(~np.isnan(evaluation.inputs), axis=0)
        worth = {row: metrics.equal_information(gains, *regime) / samples for row, regime in told.items()}
        _, beliefs, twins, _ = roll_out(name, track, systems, seed, {"plant_spread": 0.0})
        means = np.array([belief.coefficients_mean for belief in beliefs])
        errors = {"twin_rmse": metrics.simulation_errors(means, twins)}
        if record_available():
            errors["arrow_rmse"] = metrics.arrow_errors(means)
        found[name] = {"fisher_gain": gains, **worth, **errors}
    return found


def main(config: Config) -> None:
    """Compare, print, write."""
    results = {}
    for limit, (track, names) in COMPARISONS.items():
        compared = compare(track, names, config.systems, config.seed)
        results[limit] = {
            policy: {name: center_and_interval(values[name][None], row) for name, row in ROWS.items() if name in values}
            for policy, values in compared.items()
        }
    floor = None
    if record_available():
        floor = float(metrics.arrow_errors(coefficients_of(difference(), SILVERBOX_TWIN)[None])[0])
    show(results, floor)
    written = {"systems": config.systems, "seed": config.seed, "twin_on_the_arrow": floor, "comparisons": results}
    write_atomically(config.json, json.dumps(finite(written), indent=2, allow_nan=False) + "\n")
    print(config.json)


def show(results: dict[str, Any], floor: float | None) -> None:
    """Print a table for each limit."""
    from rich import box
    from rich.console import Console
    from rich.table import Table

    console = Console(markup=False)
    console.width = max(console.width, 120)
    for limit, policies in results.items():
        track, _ = COMPARISONS[limit]
        table = Table(f"{limit}: {track}", *policies, box=box.MARKDOWN)
        for name, row in ROWS.items():
            if any(name in entry for entry in policies.values()):
                cells = (cell_of(row, entry.get(name)).replace("\n", " ") for entry in policies.values())
                table.add_row(row.title, *cells)
        console.print(table)
    if floor is not None:
        console.print(f"The twin itself, with its true coefficients, simulates the real arrow to {1e3 * floor:.2f} mV.")


if __name__ == "__main__":
    run_script(main, Config, __doc__ or "")
