"""Policies compared: evaluated on the same systems, in a table, a file, and figures or a report."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from agents.evaluation.leaderboard import print_estimators, print_table, write_evaluations
from agents.evaluation.rollout import Evaluation, evaluate
from duffing_env.silverbox import record_available


def compare(
    policies: Sequence[str],
    env_id: str,
    systems: int,
    options: dict[str, Any],
    folder: Path,
    *,
    seed: int = 0,
    report: bool = False,
) -> list[Evaluation]:
    """Evaluate policies; print the tables, and write ``evaluation.json`` and the figures or the report."""
    from rich.console import Console

    console = Console()
    with console.status("Evaluating") as status:
        evaluations = evaluate(
            policies, env_id, systems, seed, options, lambda name: status.update(f"Evaluating {name}")
        )
    title = f"{env_id}, {systems} systems"
    print_table(evaluations, title)
    print_estimators(evaluations)
    if not record_available():
        print("What is measured by the Silverbox record is left out: the Silverbox record is not on this machine.")
    settings = {"env": env_id, "systems": systems, "seed": seed, "options": options}
    write_evaluations(folder / "evaluation.json", evaluations, settings)
    written = ["evaluation.json"]
    if report:
        from agents.evaluation.report import write_report

        write_report(folder / "report.html", evaluations, settings, [Path(sys.argv[0]).name, *sys.argv[1:]])
        written += ["report.html"]
    else:
        from agents.evaluation.figures import figure_of_contraction, figure_of_inputs, save

        save(figure_of_contraction(evaluations, title), folder / "contraction.png")
        save(figure_of_inputs(evaluations), folder / "excitations.png")
        written += ["contraction.png", "excitations.png"]
    for name in written:
        print(folder / name)
    return evaluations
