"""Policies compared: evaluated on the same systems, in a table, a file, and figures or a report."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from agents.cli import RIG_TRACK
from agents.evaluation.leaderboard import print_estimators, print_headline, print_table, write_evaluations
from agents.evaluation.rollout import Evaluation, evaluate
from agents.loading import spec_of
from agents.policies import TRAINED, trained_policies
from agents.policies.learned import load_policy
from agents.results import check_file, check_folder, say
from duffing_env.plants.silverbox_record import record_available
from estimator.extras import how_to_get, is_missing, need
from estimator.progress import progress

#: What every input has to beat.
SIGNALS = ("prbs", "uniform")


def usual_policies(env_id: str, options: dict[str, Any]) -> tuple[str, ...]:
    """What is compared on a track where nothing else is asked for.

    That is what ships for it, the shield alone, the planner, and two signals.

    A record can be asked for its own input only; and all but the signals look at the posterior.
    """
    usual = spec_of(env_id).kwargs
    if usual.get("regime") is not None:
        return (f"silverbox-{options.get('regime', 'multisine')}",)
    if {**usual, **options}.get("observation", "posterior") != "posterior":
        return SIGNALS
    shipped = [name for name in trained_policies() if load_policy(TRAINED / name).card["track"] == env_id]
    # These decide sample by sample.
    deciders = ["shield", "efe"] if options.get("hold", 1) == 1 else []
    return (*shipped, *deciders, *SIGNALS)


def compare(
    policies: Sequence[str],
    env_id: str,
    systems: int,
    options: dict[str, Any],
    folder: Path,
    *,
    seed: int = 0,
    report: bool = False,
    briefly: bool = False,
) -> list[Evaluation]:
    """Evaluate policies; print the tables, and write ``evaluation.json`` and the figures or the report.

    Args:
        policies: as of `agents.evaluation.rollout.evaluate`.
        env_id: the track.
        systems: that every policy is evaluated on.
        options: of the environment.
        folder: to write to.
        seed: of systems and noise.
        report: whether to write a report in place of the figures.
        briefly: whether to print the chief figures alone, a line for each policy.

    Raises:
        ModuleNotFoundError: for a report without matplotlib. Figures are left out without it.
        OSError: where the folder is a file, or nothing can be written there, before a policy plays.
    """
    if report:
        need("matplotlib")
    check_folder("report" if report else "output", folder)
    check_file("evaluation.json", folder / "evaluation.json")
    with progress("Evaluating") as tell:
        evaluations = evaluate(policies, env_id, systems, seed, options, tell=tell)
    title = f"{env_id}, {systems} systems"
    settings = {"env": env_id, "systems": systems, "seed": seed, "options": options}
    write_evaluations(folder / "evaluation.json", evaluations, settings)
    written = ["evaluation.json"]
    if report:
        from agents.evaluation.report import write_report

        write_report(folder / "report.html", evaluations, settings, [Path(sys.argv[0]).name, *sys.argv[1:]])
        written += ["report.html"]
    elif not is_missing("matplotlib"):
        from agents.evaluation.figures import figure_of_contraction, figure_of_inputs, save

        save(figure_of_contraction(evaluations, title), folder / "contraction.png")
        save(figure_of_inputs(evaluations), folder / "excitations.png")
        written += ["contraction.png", "excitations.png"]
    if briefly:
        print_headline(evaluations, title)
    else:
        print_table(evaluations, title)
        print_estimators(evaluations)
    if not briefly and not record_available() and env_id != RIG_TRACK and "error_m" in evaluations[0].metrics:
        say("What is measured by the Silverbox record is left out: the Silverbox record is not on this machine.")
    if len(written) == 1:
        say(f"Figures are left out: {how_to_get('matplotlib')}")
    for name in written:
        say(str(folder / name))
    return evaluations
