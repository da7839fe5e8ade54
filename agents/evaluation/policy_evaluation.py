"""Evaluation of policies on common random numbers: the same systems and the same noise for every policy."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np

from agents.evaluation import metrics
from agents.evaluation.estimator_comparison import estimate_with_other_estimators
from agents.evaluation.policy_arguments import check_policies_can_play, policy_group, policy_title
from agents.evaluation.policy_rollout import Evaluation, PolicySpec, run_episodes
from agents.evaluation.track_batch import TEST_OPTIONS
from duffing_env.experiment_config import SimulatedExperiment
from duffing_env.plants.silverbox_record import record_available
from estimator.models.difference_equation import difference
from estimator.models.duffing import duffing
from estimator.support.argument_checks import MAX_SEED, check_integer
from estimator.support.array_types import FloatArray
from estimator.support.progress import ProgressCallback, ignore_progress

#: Largest number of systems of an evaluation, whose inputs and outputs are all kept in memory.
_MAX_SYSTEMS = 100_000

#: Fraction of an evaluation's time, about, that its episodes take.
_EPISODE_TIME_FRACTION = 0.7


def evaluate_policies(
    policies: Sequence[PolicySpec],
    env_id: str = "duffing_env/Amplitude-v0",
    systems: int = 256,
    seed: int = 0,
    options: dict[str, Any] | None = None,
    on_policy: Callable[[str], None] | None = None,
    on_progress: ProgressCallback = ignore_progress,
) -> list[Evaluation]:
    """Evaluate policies on common random numbers: the same oscillators and the same noise for all of them.

    Systems are of the branch ``test`` of the seeds, which no training uses, unless the options name another branch.

    Learned policies act by their mean. With ``hold`` in the options, inputs, outputs and metrics are of every sample; a
    stored oracle is of the track without ``hold``. An episode that a limit ends is not dropped: it counts with its last
    belief. Fisher information, with the true noises, and other estimators need a simulated plant whose truth is
    constant. With the Silverbox record, the tracks' oscillators also get the number of samples of its regime with as
    much information; and the difference equation gets the errors of free runs over the arrow's input and, identified on
    the track's twin (``plant_spread=0``), over the arrow's record. The differential equation does not: the simulated
    plant has no offsets, and the offsets of the circuit, 8 mV at the input, would be nearly all of its error (5.3 mV
    for the twin itself).

    Policies that were trained with several seeds of one configuration are one entry: ``TITLE=PATTERN`` is the title of
    the entry and a pattern of their folders, such as ``ppo=runs/ppo-amplitude-v0-[0-4]``.

    Args:
        policies: at least one: arguments of `agents.policies.make_policy`, or patterns as above. An object has the
            title of its ``name``, or of its class.
        env_id: a registered track.
        systems: number of systems, 2 to 100,000.
        seed: of systems and noise, and of the policies.
        options: of the environment.
        on_policy: called with each policy's name before its episodes.
        on_progress: called with the fraction that is done, and each policy's name
            (`estimator.support.progress.show_progress`).

    Raises:
        ValueError: for no policies, an unknown policy, a pattern with fewer than two policies, fewer than two systems,
            or options that the track refuses.
    """
    if isinstance(policies, str):
        raise ValueError(f"policies must be a list of policies, but is {policies!r:.60}; pass [{policies!r:.60}]")
    if not policies:
        raise ValueError("policies must name at least one policy, but names none; pass e.g. uniform")
    check_integer("systems", systems, _MAX_SYSTEMS, 2)  # intervals need more than one
    check_integer("seed", seed, MAX_SEED, 0)
    options = TEST_OPTIONS | (options or {})
    groups = [policy_group(name) for name in policies]
    titles = [policy_title(members[0]) if title is None else title for title, members in groups]
    if len(set(titles)) < len(titles):
        raise ValueError(f"policies must differ by their names, but are called {titles}; give each a name of its own")
    check_policies_can_play([member for _, members in groups for member in members], env_id, options, seed)
    evaluations = []
    silverbox_information: dict[str, FloatArray] = {}
    done, total = 0, sum(len(members) for _, members in groups)
    for title, members in groups:
        group_evaluations = []
        for member in members:
            if on_policy is not None:
                on_policy(policy_title(member))
            report_fraction = partial(_report_fraction_done, on_progress, done, total, policy_title(member))
            group_evaluations.append(
                _evaluate_policy(member, env_id, systems, seed, options, silverbox_information, report_fraction)
            )
            done += 1
        evaluations.append(group_evaluations[0] if title is None else pool_seeds(title, group_evaluations))
    return evaluations


def _report_fraction_done(on_progress: ProgressCallback, done: int, total: int, name: str, fraction: float) -> None:
    """Report the fraction that is done of all policies."""
    on_progress((done + fraction) / total, name)


def pool_seeds(title: str, evaluations: Sequence[Evaluation]) -> Evaluation:
    """One evaluation of several training seeds, which must have been evaluated on the same systems."""

    def join(tables: list[dict[str, FloatArray]]) -> dict[str, FloatArray]:
        return {name: np.concatenate([table[name] for table in tables]) for name in tables[0]}

    return Evaluation(
        title,
        join([e.metrics for e in evaluations]),
        np.concatenate([e.gain_curve for e in evaluations], axis=1),
        np.concatenate([e.inputs for e in evaluations], axis=1),
        np.concatenate([e.outputs for e in evaluations], axis=1),
        evaluations[0].scales,
        {name: join([e.estimator_metrics[name] for e in evaluations]) for name in evaluations[0].estimator_metrics},
        sum(e.seeds for e in evaluations),
        evaluations[0].limits,
    )


def _evaluate_policy(
    policy: PolicySpec,
    env_id: str,
    systems: int,
    seed: int,
    options: dict[str, Any],
    silverbox_information: dict[str, FloatArray],
    on_progress: ProgressCallback,
) -> Evaluation:
    """Evaluate one policy; ``silverbox_information`` caches the information of the Silverbox regime on the systems."""
    evaluation, beliefs, truth, experiment = run_episodes(
        policy, env_id, systems, seed, options, lambda share: on_progress(_EPISODE_TIME_FRACTION * share)
    )
    if not isinstance(experiment, SimulatedExperiment):
        return evaluation
    policy_metrics, truth_is_constant = evaluation.metrics, experiment.jump == 0
    is_difference = experiment.plant == difference()
    if truth_is_constant:
        gains = metrics.fisher_information_gain(evaluation.inputs, truth, experiment, evaluation.outputs)
        policy_metrics["fisher_gain"] = gains
        evaluation.estimator_metrics.update(
            estimate_with_other_estimators(evaluation.inputs, evaluation.outputs, truth, experiment)
        )
        if seed == 0:  # oracles are stored for the systems of this seed
            policy_metrics |= metrics.d_efficiency_metrics(evaluation.inputs, evaluation.outputs, env_id, options)
    if not record_available():  # the following metrics need the record
        return evaluation
    if truth_is_constant and (is_difference or experiment.plant == duffing()):
        silverbox_information.update(
            silverbox_information or metrics.silverbox_information_by_metric(truth, experiment, seed)
        )
        policy_metrics |= {
            regime: metrics.equivalent_segment_lengths(gains, information)
            for regime, information in silverbox_information.items()
        }
    if is_difference:
        means = np.array([belief.coefficients_mean for belief in beliefs])
        policy_metrics["simulation_rmse"] = metrics.twin_simulation_rmse(means, truth)
    if truth_is_constant and is_difference:
        _, twin_beliefs, _, _ = run_episodes(policy, env_id, systems, seed, {**options, "plant_spread": 0.0})
        policy_metrics["arrow_rmse"] = metrics.arrow_simulation_rmse(
            np.array([twin.coefficients_mean for twin in twin_beliefs])
        )
    return evaluation
