"""Roll-out of a policy on every system of a track: inputs, outputs, beliefs and metrics of the episodes."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from agents.evaluation import metrics
from agents.evaluation.policy_arguments import check_predict_signature, policy_title
from agents.evaluation.track_batch import make_track_batch
from agents.policies import Policy, make_policy
from agents.user_code import attribute_user_errors
from duffing_env.experiment_config import Experiment
from duffing_env.storage.kernel_spec import last_input_entries, observation_bounds, parameter_names
from duffing_env.vector_env import DuffingVectorEnv
from estimator.belief import Belief
from estimator.models.named_parameters import Parameters
from estimator.rigs.physical_parameters import coefficients_of
from estimator.rigs.units import Scales
from estimator.support.argument_checks import mask_control_codes
from estimator.support.array_types import FloatArray
from estimator.support.progress import ProgressCallback, ignore_progress

#: A policy by its name, its folder or its class, or a policy object (`agents.policies.make_policy`).
PolicySpec = Any


@dataclass(frozen=True)
class Evaluation:
    """The episodes of one policy, system by system; or of several training seeds of one configuration.

    Arrays over systems hold the systems of the first seed, then the same systems for the second seed, and so on.

    Attributes:
        policy: name of the policy, or of the group of seeds.
        metrics: name of a metric (`agents.evaluation.metric_summary.METRIC_COLUMNS`) to its values (systems,).
        gain_curve: (horizon + 1, systems) gain of the log posterior at the truth over the samples [nats], including the
            loss at a jump of the truth.
        inputs: (horizon, systems) inputs of the plant, in units of their scale, NaN after the end of an episode;
            (horizon, systems, inputs) of several inputs.
        outputs: (horizon, systems) outputs, likewise; (horizon, systems, sensors) for several sensors.
        scales: units of inputs and outputs, and the sampling step.
        estimator_metrics: name of another estimator to its metrics on the same inputs and outputs.
        seeds: number of training seeds.
        limits: of the first input and the first output, in units of their scales.
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
        """The name without control codes of terminals, and the number of seeds where there are several."""
        name = mask_control_codes(self.policy)
        return name if self.seeds == 1 else f"{name} ({self.seeds} seeds)"


class PlayedEpisodes(NamedTuple):
    """One episode of every system.

    Attributes:
        evaluation: with the metrics of the episodes.
        beliefs: at the end of each episode.
        truth: true parameters (systems,) at the end of each episode.
        experiment: of the environments.
    """

    evaluation: Evaluation
    beliefs: list[Belief]
    truth: Parameters
    experiment: Experiment


def one_channel(series: FloatArray) -> FloatArray:
    """A series (T, n, channels), without the last axis where there is one channel."""
    return series[..., 0] if series.shape[-1] == 1 else series


def run_episodes(
    name: PolicySpec,
    env_id: str,
    systems: int,
    seed: int,
    options: dict[str, Any],
    on_progress: ProgressCallback = ignore_progress,
) -> PlayedEpisodes:
    """Play one episode of every system; ``on_progress`` is called with the fraction of the samples that is done."""
    envs = make_track_batch(env_id, systems, options)
    policy = make_policy(name, envs, seed=seed)
    check_predict_signature(policy, name)
    hold = envs.experiment.hold
    if hold > 1:  # the policy's inputs are held here instead, with the same result, so that every sample is recorded
        envs = make_track_batch(env_id, systems, {**options, "hold": 1})
    trace = _play_episodes(policy, name, env_id, envs, hold, seed, on_progress)
    envs.close()
    parameters = trace.initial_truth
    truth = Parameters({p: np.array([getattr(t, p) for t in trace.truths]) for p in parameters})
    _add_jump_losses(trace, truth)
    prior, beliefs = trace.prior, trace.beliefs
    means = np.array([belief.coefficients_mean for belief in beliefs])
    covs = np.array([belief.coefficients_cov for belief in beliefs])
    inputs, outputs = one_channel(trace.inputs), one_channel(trace.outputs)
    values = {
        "information_gain": np.array([prior.entropy() - belief.entropy() for belief in beliefs]),
        "log_posterior_gain": trace.gain_curve[-1],
        **metrics.posterior_metrics(means, covs, truth, prior.model, prior.scales),
        "ended_early": trace.ended_early,
        **metrics.input_metrics(one_channel(trace.inputs * prior.scales.input_scales(prior.model.n_inputs))),
        # Processor time. The first call may compile, and counts where there is no other.
        "decision_time": np.full(systems, np.mean(trace.decision_times[1:] or trace.decision_times) / systems),
    }
    setup = envs.experiment.kernel_params
    evaluation = Evaluation(
        policy_title(name),
        values,
        trace.gain_curve,
        inputs,
        outputs,
        prior.scales,
        limits=(float(setup.max_input[0]), setup.max_output),
    )
    return PlayedEpisodes(evaluation, beliefs, truth, envs.experiment)


@dataclass
class _EpisodeTrace:
    """Records of one episode of every system, as of `Evaluation`, before the metrics.

    Attributes:
        prior: belief at the start.
        initial_truth: true parameters at the start.
        gain_curve: as of `Evaluation`.
        inputs: (horizon, systems, inputs), as of `Evaluation`.
        outputs: (horizon, systems, sensors), as of `Evaluation`.
        beliefs, truths: of each system at the end of its episode.
        ended_early: 1 where a limit ended the episode, else 0.
        jumped_at: sample at which the truth jumped, else the horizon.
        decision_times: processor time of each call of the policy [s].
    """

    prior: Belief
    initial_truth: Parameters
    gain_curve: FloatArray
    inputs: FloatArray
    outputs: FloatArray
    beliefs: list[Belief]
    truths: list[Parameters]
    ended_early: FloatArray
    jumped_at: npt.NDArray[np.int64]
    decision_times: list[float] = field(default_factory=list)

    @classmethod
    def of(cls, envs: DuffingVectorEnv, systems: int) -> _EpisodeTrace:
        """An empty record for environments that were reset."""
        prior, truth, horizon = envs.belief(0), envs.truth, envs.horizon
        return cls(
            prior,
            truth,
            np.zeros((horizon + 1, systems)),
            np.full((horizon, systems, envs.experiment.model.n_inputs), np.nan),
            np.full((horizon, systems, envs.experiment.model.n_outputs), np.nan),
            [prior] * systems,
            [truth] * systems,
            np.zeros(systems),
            np.full(systems, horizon),
        )


def _play_episodes(
    policy: Policy,
    name: PolicySpec,
    env_id: str,
    envs: DuffingVectorEnv,
    hold: int,
    seed: int,
    on_progress: ProgressCallback,
) -> _EpisodeTrace:
    """Play one episode of every row; a policy's input is held for ``hold`` samples."""
    systems, horizon, first = envs.num_envs, envs.horizon, _last_input_index(envs.experiment)
    first_output = first + envs.experiment.model.n_inputs
    last_inputs = slice(first, first_output)
    last_outputs = slice(first_output, first_output + envs.experiment.model.n_outputs)
    max_inputs = envs.experiment.max_inputs
    first_parameter = parameter_names(envs.experiment.truth_model)[0]
    observations, _ = envs.reset(seed=seed)
    trace = _EpisodeTrace.of(envs, systems)
    initial_value = getattr(trace.initial_truth, first_parameter)
    running = np.ones(systems, dtype=np.bool_)
    state, episode_start = None, np.ones(systems, dtype=np.bool_)
    for t in range(horizon):
        on_progress(t / horizon)
        try:
            if t % hold == 0:
                started = time.process_time()
                with attribute_user_errors(name, "policy"):
                    actions, state = policy.predict(observations, state, episode_start, deterministic=True)
                trace.decision_times.append(time.process_time() - started)
                episode_start = np.zeros(systems, dtype=np.bool_)
            observations, _, terminated, truncated, infos = envs.step(actions)
        except ValueError as error:
            raise ValueError(f"policy {policy_title(name)} does not play {env_id}: {error}") from error
        trace.gain_curve[t + 1] = trace.gain_curve[t] + np.where(running, infos["log_posterior_gain"], 0.0)
        has_jumped = getattr(envs.truth, first_parameter) != initial_value
        trace.jumped_at[running & (trace.jumped_at == horizon) & has_jumped] = t
        trace.inputs[t, running] = max_inputs * observations[running, last_inputs]
        trace.outputs[t, running] = envs.experiment.max_output * observations[running, last_outputs]
        finished = running & (terminated | truncated)
        for row in np.flatnonzero(finished):
            trace.beliefs[row], trace.truths[row] = infos["belief"][row], infos["truth"][row]
        trace.ended_early[finished & terminated] = 1.0
        running &= ~finished
        episode_start |= terminated | truncated
        if not running.any():
            trace.gain_curve[t + 2 :] = trace.gain_curve[t + 1]
            break
    return trace


def _add_jump_losses(trace: _EpisodeTrace, truth: Parameters) -> None:
    """Subtract from the gain curve, at each jump of the truth, the loss that the environment's rewards leave out."""
    jumped = np.flatnonzero(trace.jumped_at < len(trace.inputs))
    if not len(jumped):
        return
    prior = trace.prior
    before, after = (coefficients_of(prior.model, t, prior.scales) for t in (trace.initial_truth, truth))
    for row in jumped:
        gain = trace.beliefs[row].log_prob(after[row]) - prior.log_prob(before[row])
        trace.gain_curve[trace.jumped_at[row] + 1 :, row] += gain - trace.gain_curve[-1, row]


def _last_input_index(experiment: Experiment) -> int:
    """Index of the first last input in an observation; the further ones and the last outputs follow it."""
    if experiment.observation == "history":
        return (experiment.history - 1) * (experiment.model.n_inputs + experiment.model.n_outputs)
    if callable(experiment.observation):
        raise ValueError(
            "observation must not be a function where policies are compared, which need the last input and outputs; "
            "take 'posterior', 'history' or 'privileged'"
        )
    return list(observation_bounds(experiment.model)).index(last_input_entries(experiment.model)[0])
