"""What policies are worth: any number of them, on the same systems and the same noise."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np

from agents.evaluation import metrics
from agents.evaluation.estimator_comparison import estimate_with_other_estimators
from agents.evaluation.policy_groups import (
    check_policies_can_play,
    check_predict_signature,
    policy_group,
    policy_title,
)
from agents.evaluation.track_batch import TEST_OPTIONS, make_track_batch
from agents.policies import make_policy
from agents.user_code import attribute_user_errors
from duffing_env.experiment_config import Experiment, SimulatedExperiment
from duffing_env.plants.silverbox_record import record_available
from duffing_env.storage.kernel_spec import observation_bounds, parameter_names
from estimator.belief import Belief
from estimator.models.difference_equation import difference
from estimator.models.duffing import duffing
from estimator.models.named_parameters import Parameters
from estimator.rigs.physical_parameters import coefficients_of
from estimator.rigs.units import Scales
from estimator.support.argument_checks import MAX_SEED, check_integer, mask_control_codes
from estimator.support.array_types import FloatArray
from estimator.support.progress import ProgressCallback, ignore_progress

#: Systems that one evaluation keeps in memory, with all that they did.
_MAX_SYSTEMS = 100_000

#: Of the time that a policy takes, about so much is playing.
_EPISODE_TIME_FRACTION = 0.7


@dataclass(frozen=True)
class Evaluation:
    """What happened under one policy, system by system; or under several of one recipe, which differ by their seeds.

    Arrays over systems hold those of the first seed, then those of the second, and so on: the same systems again.

    Attributes:
        policy: its name, or that of the recipe.
        metrics: name of a metric to its value for each system (systems,); see `agents.evaluation.metric_summary.METRIC_COLUMNS`.
        gain_curve: (horizon + 1, systems) gain of log posterior of the truth over the samples [nats]; what a jump of the
            truth takes away is in it.
        inputs: (horizon, systems) inputs that the plant was given, in parts of their scale, NaN after the end of an
            episode.
        outputs: (horizon, systems) outputs, likewise; (horizon, systems, sensors) of several sensors.
        scales: what one of them is worth, and the sampling step: 1 V, or what the rig says.
        estimator_metrics: what others make of the same inputs and outputs: name of an estimator to its `metrics`.
        seeds: number of policies.
        limits: of input and output, in parts of their scales.
    """

    policy: str
    metrics: dict[str, FloatArray]
    gain_curve: FloatArray
    inputs: FloatArray
    outputs: FloatArray
    scales: Scales
    estimator_metrics: dict[str, dict[str, FloatArray]] = field(default_factory=dict)
    seeds: int = 1
    limits: tuple[float, float] = (np.inf, np.inf)

    @property
    def title(self) -> str:
        """The name, without control codes, which a terminal would obey; and of several the number of seeds."""
        name = mask_control_codes(self.policy)
        return name if self.seeds == 1 else f"{name} ({self.seeds} seeds)"


def evaluate_policies(
    policies: Sequence[Any],
    env_id: str = "duffing_env/Amplitude-v0",
    systems: int = 256,
    seed: int = 0,
    options: dict[str, Any] | None = None,
    on_policy: Callable[[str], None] | None = None,
    on_progress: ProgressCallback = ignore_progress,
) -> list[Evaluation]:
    """Evaluate policies on common random numbers: the same oscillators and the same noise for all of them.

    They are of the branch ``test`` of the seeds, unless the options name another: no training meets them.

    Learned policies act by their mean. With ``hold`` in the options, inputs, outputs and what is made of them are those
    of every sample; a stored oracle is that of the track without it. An episode that a limit ends is never dropped: it
    counts with what was known by then. Information at the truth, with the true noises, and what other estimators make
    of the inputs and outputs need a simulated plant whose truth stays as it is. With the Silverbox record there are
    also the samples of its regime that tell as much, for the oscillators of the tracks; and for the difference equation
    the errors of free runs over the arrow's input and, identified on the track's twin (``plant_spread=0``), over the
    arrow's record. The differential equation has no such place: the simulated plant has no offsets, and those of
    the circuit, 8 mV at the input, would be nearly all of its error (5.3 mV for the twin itself).

    Policies that training made of one recipe with different seeds are one entry: ``TITLE=PATTERN`` is the title of the
    entry and a pattern of their folders, such as ``ppo=runs/ppo-amplitude-v0-[0-4]``.

    Args:
        policies: at least one: what `agents.policies.make_policy` takes, or patterns as above. A thing of one's own
            is titled by its ``name``, or that of its class.
        env_id: a registered track.
        systems: number of systems, 2 to 100,000.
        seed: of systems and noise; and of the policies' own randomness.
        options: of the environment.
        on_policy: called with each policy's name before its turn.
        on_progress: is told the share that is done, and each policy's name (`estimator.support.progress.show_progress`).

    Raises:
        ValueError: for no policies, an unknown one, a pattern that less than two policies match, fewer than two
            systems, or options that the track does not take.
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
    """Tell the share that is done of all policies."""
    on_progress((done + fraction) / total, name)


def pool_seeds(title: str, evaluations: Sequence[Evaluation]) -> Evaluation:
    """Policies of one recipe as one entry; they must have been evaluated on the same systems."""

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
    policy: Any,
    env_id: str,
    systems: int,
    seed: int,
    options: dict[str, Any],
    silverbox_information: dict[str, FloatArray],
    on_progress: ProgressCallback,
) -> Evaluation:
    """One policy; ``silverbox_information`` keeps what the Silverbox regime tells of the systems, which are those of all policies."""
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
        if seed == 0:  # whose systems in this branch an oracle may be stored of
            policy_metrics |= metrics.d_efficiency_metrics(evaluation, env_id, options)
    if not record_available():  # what follows is measured by it
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


def run_episodes(
    name: Any,
    env_id: str,
    systems: int,
    seed: int,
    options: dict[str, Any],
    on_progress: ProgressCallback = ignore_progress,
) -> tuple[Evaluation, list[Belief], Any, Experiment]:
    """One episode of every system; the beliefs it ended with, the truth and the experiment.

    ``on_progress`` is told the share of the samples that were played.
    """
    envs = make_track_batch(env_id, systems, options)
    policy = make_policy(name, envs, seed=seed)
    check_predict_signature(policy, name)
    hold = envs.experiment.hold
    if hold > 1:  # applied sample by sample instead, which is the same, so that every sample is seen
        envs = make_track_batch(env_id, systems, {**options, "hold": 1})
    sensors, last_input = envs.experiment.model.n_outputs, _last_input_index(envs.experiment)
    last_outputs = slice(last_input + 1, last_input + 1 + sensors)
    first_parameter = parameter_names(envs.experiment.truth_model)[0]
    observations, _ = envs.reset(seed=seed)
    prior, horizon = envs.belief(0), envs.horizon
    initial_truth, curve = envs.truth, np.zeros((horizon + 1, systems))
    inputs, outputs = np.full((horizon, systems), np.nan), np.full((horizon, systems, sensors), np.nan)
    beliefs: list[Belief] = [prior] * systems
    truths = [initial_truth] * systems
    ended_early, jumped_at = np.zeros(systems), np.full(systems, horizon)
    running = np.ones(systems, dtype=np.bool_)
    state, episode_start = None, np.ones(systems, dtype=np.bool_)
    decision_times: list[float] = []
    for t in range(horizon):
        on_progress(t / horizon)
        try:
            if t % hold == 0:
                started = time.process_time()
                with attribute_user_errors(name, "policy"):
                    actions, state = policy.predict(observations, state, episode_start, deterministic=True)
                decision_times.append(time.process_time() - started)
                episode_start = np.zeros(systems, dtype=np.bool_)
            observations, _, terminated, truncated, infos = envs.step(actions)
        except ValueError as error:
            raise ValueError(f"policy {policy_title(name)} does not play {env_id}: {error}") from error
        curve[t + 1] = curve[t] + np.where(running, infos["log_posterior_gain"], 0.0)
        jumped_at[
            running
            & (jumped_at == horizon)
            & (getattr(envs.truth, first_parameter) != getattr(initial_truth, first_parameter))
        ] = t
        inputs[t, running] = envs.max_input * observations[running, last_input]
        outputs[t, running] = envs.experiment.max_output * observations[running, last_outputs]
        finished = running & (terminated | truncated)
        for row in np.flatnonzero(finished):
            beliefs[row], truths[row] = infos["belief"][row], infos["truth"][row]
        ended_early[finished & terminated] = 1.0
        running &= ~finished
        episode_start |= terminated | truncated
        if not running.any():
            curve[t + 2 :] = curve[t + 1]
            break
    envs.close()
    truth = Parameters({p: np.array([getattr(t, p) for t in truths]) for p in initial_truth})
    means = np.array([belief.coefficients_mean for belief in beliefs])
    covs = np.array([belief.coefficients_cov for belief in beliefs])
    # The environment does not count what a jump of the truth takes away: what lacks at the end was lost there.
    jumped = np.flatnonzero(jumped_at < horizon)
    if len(jumped):
        model, scales = prior.model, prior.scales
        before, after = (coefficients_of(model, t, scales) for t in (initial_truth, truth))
        for row in jumped:
            gain = beliefs[row].log_prob(after[row]) - prior.log_prob(before[row])
            curve[jumped_at[row] + 1 :, row] += gain - curve[-1, row]
    values = {
        "information_gain": np.array([prior.entropy() - belief.entropy() for belief in beliefs]),
        "log_posterior_gain": curve[-1],
        **metrics.posterior_metrics(means, covs, truth, prior.model, prior.scales),
        "ended_early": ended_early,
        **metrics.input_metrics(prior.scales.input * inputs),
        # Processor time. The first call may compile, and counts where there is no other.
        "decision_time": np.full(systems, np.mean(decision_times[1:] or decision_times) / systems),
    }
    stored_outputs = outputs[..., 0] if sensors == 1 else outputs
    setup = envs.experiment.kernel_params
    evaluation = Evaluation(
        policy_title(name),
        values,
        curve,
        inputs,
        stored_outputs,
        prior.scales,
        limits=(setup.max_input, setup.max_output),
    )
    return evaluation, beliefs, truth, envs.experiment


def _last_input_index(experiment: Experiment) -> int:
    """Where an observation has the last input, which the last outputs follow."""
    if experiment.observation == "history":
        return (experiment.history - 1) * (1 + experiment.model.n_outputs)
    if callable(experiment.observation):
        raise ValueError(
            "observation must not be a function where policies are compared, which need the last input and outputs; "
            "take 'posterior', 'history' or 'privileged'"
        )
    return list(observation_bounds(experiment.model)).index("last_input")
