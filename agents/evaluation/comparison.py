"""Comparison of policies on the same systems: tables, evaluation.json, and figures or an HTML report."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from agents.console_output import print_in_80_columns
from agents.evaluation.comparison_tables import (
    ComparisonSettings,
    print_comparison_table,
    print_estimator_table,
    print_headline_table,
    write_evaluations,
)
from agents.evaluation.policy_evaluation import evaluate_policies
from agents.evaluation.policy_rollout import Evaluation
from agents.output_paths import check_output_file, check_output_folder
from agents.policies import TRAINED, trained_policies
from agents.policies.networks.trained_policy import load_policy
from agents.track_ids import RIG_TRACK
from agents.user_code import env_spec_of
from duffing_env.plants.silverbox_record import record_available
from estimator.support.optional_dependencies import install_hint, is_not_installed, require_packages
from estimator.support.progress import show_progress

#: Signals in every default comparison.
BASELINE_SIGNALS = ("prbs", "uniform")


def default_policies(env_id: str, options: dict[str, Any]) -> tuple[str, ...]:
    """The policies that are compared on a track by default: trained ones that ship, shield, planner and two signals.

    On a record, its own input is the only policy; without the posterior in the observation, only the signals play.
    """
    track_options = env_spec_of(env_id).kwargs
    if track_options.get("regime") is not None:
        return (f"silverbox-{options.get('regime', 'multisine')}",)
    if {**track_options, **options}.get("observation", "posterior") != "posterior":
        return BASELINE_SIGNALS
    shipped = [name for name in trained_policies() if load_policy(TRAINED / name).card["track"] == env_id]
    # These choose an input for every sample.
    per_sample_policies = ["shield", "efe"] if options.get("hold", 1) == 1 else []
    return (*shipped, *per_sample_policies, *BASELINE_SIGNALS)


def compare_policies(
    policies: Sequence[str],
    env_id: str,
    n_systems: int,
    options: dict[str, Any],
    folder: Path,
    *,
    seed: int = 0,
    as_report: bool = False,
    headline_only: bool = False,
) -> list[Evaluation]:
    """Evaluate policies; print the tables, and write ``evaluation.json`` and the figures or the report.

    Args:
        policies: as of `agents.evaluation.policy_evaluation.evaluate_policies`.
        env_id: the track.
        n_systems: number of systems.
        options: of the environment.
        folder: for the files.
        seed: of systems and noise.
        as_report: whether to write a report in place of the figures.
        headline_only: whether to print the headline table alone.

    Raises:
        ModuleNotFoundError: for a report without matplotlib; without it figures are left out.
        OSError: for a folder that is a file or cannot be written to, before a policy plays.
    """
    if as_report:
        require_packages("matplotlib")
    check_output_folder("report" if as_report else "output", folder)
    check_output_file("evaluation.json", folder / "evaluation.json")
    with show_progress("Evaluating") as on_progress:
        evaluations = evaluate_policies(policies, env_id, n_systems, seed, options, on_progress=on_progress)
    title = f"{env_id}, {n_systems} systems"
    settings = ComparisonSettings(env_id, n_systems, seed, options)
    write_evaluations(folder / "evaluation.json", evaluations, settings)
    figures = _write_report(folder, evaluations, settings) if as_report else _write_figures(folder, evaluations, title)
    if headline_only:
        print_headline_table(evaluations, title)
    else:
        print_comparison_table(evaluations, title)
        print_estimator_table(evaluations)
    if not headline_only and not record_available() and env_id != RIG_TRACK and "error_m" in evaluations[0].metrics:
        print_in_80_columns(
            "Metrics by the Silverbox record are left out: the Silverbox record is not on this machine."
        )
    if not figures:
        print_in_80_columns(f"Figures are left out: {install_hint('matplotlib')}")
    for name in ("evaluation.json", *figures):
        print_in_80_columns(str(folder / name))
    return evaluations


def _write_report(folder: Path, evaluations: list[Evaluation], settings: ComparisonSettings) -> tuple[str, ...]:
    """Write the report; returns the names of its files."""
    from agents.evaluation.html_report import write_html_report

    write_html_report(folder / "report.html", evaluations, settings, [Path(sys.argv[0]).name, *sys.argv[1:]])
    return ("report.html",)


def _write_figures(folder: Path, evaluations: list[Evaluation], title: str) -> tuple[str, ...]:
    """Write the figures, where matplotlib is installed; returns the names of their files."""
    if is_not_installed("matplotlib"):
        return ()
    from agents.evaluation.figures import plot_inputs_and_outputs, plot_log_posterior_gain, save_png

    save_png(plot_log_posterior_gain(evaluations, title), folder / "contraction.png")
    save_png(plot_inputs_and_outputs(evaluations), folder / "excitations.png")
    return "contraction.png", "excitations.png"
