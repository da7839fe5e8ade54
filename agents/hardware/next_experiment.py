"""Design of the next experiment on a rig: a safe input signal, and the intervals expected after it."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from agents.hardware.block_loop import ScaledBlock, SignalBlockDesigner
from agents.hardware.env_view import EnvView
from agents.hardware.experiment_design import ExperimentDesign
from agents.planning.model_probe import ModelView, believed_resonance
from agents.planning.open_loop.chance_constrained_block import (
    MAX_PLANNED_DRAWS,
    expected_information,
    optimise_block,
    sampled_systems,
)
from agents.planning.open_loop.expected_d_optimality import SampledSystems
from agents.planning.open_loop.initial_guesses import initial_guesses
from agents.planning.open_loop.posterior_samples import MonteCarloSystems, draw_at_rest, equilibria, required_draws
from agents.policies import make_policy
from agents.policies.efe_planner import EfePlanner
from agents.policies.signals import SignalPolicy
from agents.user_code import attribute_user_errors
from estimator.belief import Belief, covariance_indices
from estimator.identification.diagnostics.record_checks import MIN_SAMPLES_PER_PERIOD, RECOMMENDED_SAMPLES_PER_PERIOD
from estimator.inference.free_run import free_run
from estimator.models.single_input import check_single_input
from estimator.rigs.physical_parameters import propagate_to_physical
from estimator.rigs.rig import Rig
from estimator.rigs.rig_prior import rig_prior
from estimator.support.argument_checks import MAX_SEED, MIN_MAGNITUDE, check_integer, check_number
from estimator.support.array_types import FloatArray
from estimator.support.progress import ProgressCallback, ignore_progress

#: Largest length of an experiment, which is planned as a whole [samples].
_MAX_SAMPLES = 2**16

#: Total length of the noise signals from which the planner starts [samples]: long signals have fewer, because each
#: takes long to optimise. Under a wide belief, local optima differ by nats.
_NOISE_START_SAMPLES = 4096

#: Smallest number of noise signals to start from.
_MIN_NOISE_STARTS = 2

#: Largest number of noise signals to start from.
_MAX_NOISE_STARTS = 14

#: Systems on which a policy that responds to outputs is played.
_N_ROLLOUTS = 4

#: Systems whose outputs are predicted.
_N_PREDICTED_SYSTEMS = 200

#: Quantiles of the predicted outputs: a band of 90 % and the median.
_OUTPUT_QUANTILES = (0.05, 0.5, 0.95)

#: Standard deviation of a state at rest, from which the plan for the belief's means starts [scale of the state].
_REST_STD = 1e-3


def design_experiment(
    rig: Rig | Mapping[str, Any] | str | Path,
    prior: Belief | None = None,
    policy: str = "efe",
    samples: int = 256,
    bound: float = 0.05,
    seed: int = 0,
    on_progress: ProgressCallback = ignore_progress,
) -> ExperimentDesign:
    """Design the next experiment: a signal for an oscillator at rest.

    ``efe`` maximises the expected information over systems that are drawn from the belief
    (`agents.planning.open_loop.chance_constrained_block`). A policy that responds to outputs is played on some of these
    systems, and the signal with the largest expected information is taken. A signal is taken as it is. Inputs that
    would leave the range with a larger probability than the bound are scaled down.

    Args:
        rig: with the limit of the input and the range of the output.
        prior: the belief before, such as ``identify(...).belief``; None: by the rig's guess.
        policy: the name of a policy (`agents.policies.make_policy`).
        samples: of the experiment.
        bound: largest probability that the output leaves its range, under the whole belief.
        seed: of the policy, and of the systems that are drawn.
        on_progress: called with the fraction that is done (`estimator.support.progress.show_progress`).

    Raises:
        ValueError: for a rig without limit or range, or without guess where there is no prior; a prior in other
            scales; samples below 8 or above 65,536; a bound that is not a probability; where even no input is safe; or
            a step that is too long for the motion to be followed.

    Example:
        >>> from agents.hardware.next_experiment import design_experiment
        >>> from estimator import Channel, Rig
        >>> rig = Rig(1e-3, input=Channel("N", limit=20.0, noise=0.02), output=Channel("m", range=0.03, noise=5e-6),
        ...           guess={"m": (0.3, 0.5), "c": (0.1, 2.0), "a": (1e3, 5e3), "b": (0.0, 1e8)})
        >>> found = design_experiment(rig, policy="prbs", samples=256)
        >>> name, mean, (low, high), half, unit = found.parameter_rows()[0]
        >>> bool(half < (high - low) / 2), unit, found.exit_probability < 0.05, len(found.u)
        (True, 'kg', True, 256)
    """
    check_integer("samples", samples, _MAX_SAMPLES, 8)
    check_number("bound", bound, MIN_MAGNITUDE, 1 - MIN_MAGNITUDE, "0.05 is usual")
    check_integer("seed", seed, MAX_SEED, 0)
    rig = Rig.from_any(rig)
    belief = rig_prior(rig) if prior is None else prior
    check_single_input("the design of an experiment", belief.model, "play a signal such as prbs in an environment")
    env_view = EnvView(rig, belief, int(samples))
    rng = np.random.default_rng(seed)
    view, limit = ModelView.of(env_view.experiment), float(env_view.experiment.max_output)
    posterior_draws = draw_at_rest(belief, rng, required_draws(bound, MAX_PLANNED_DRAWS))
    futures = MonteCarloSystems(view.model, posterior_draws, limit, rng, max(0, rig.integer_delay), view.degree)
    systems = sampled_systems(view, belief, futures, int(samples))
    with attribute_user_errors(policy, "policy"):
        policy_object = make_policy(policy, env_view, seed=seed)  # type: ignore[arg-type]
    if isinstance(policy_object, EfePlanner):
        block = _optimised_block(policy_object, env_view, view, systems, futures, bound, seed, on_progress)
    elif isinstance(policy_object, SignalPolicy):
        block = SignalBlockDesigner(policy_object, env_view).design_block(int(samples), futures, bound)
    else:
        block = _best_rollout(policy, env_view, view, systems, futures, bound, seed, on_progress)
    samples_per_period = 1 / believed_resonance(belief)
    is_undersampled = samples_per_period < MIN_SAMPLES_PER_PERIOD
    if block.scale == 0.0 and block.exit_probability >= bound:
        raise ValueError(
            undersampling_message(rig.step, samples_per_period)
            if is_undersampled
            else "rig must be known well enough to stay in its range, but even without input it leaves it with "
            f"probability {block.exit_probability:.2g}, and at most {bound:.2g} is allowed; give a narrower guess or a "
            "wider range"
        )
    max_input = env_view.max_inputs[0]
    u = np.clip(block.inputs, -max_input, max_input)
    log_det_gain, covs = expected_information(view, systems, limit, u)
    if not (np.isfinite(log_det_gain) and np.isfinite(covs).all()):
        raise ValueError(
            undersampling_message(rig.step, samples_per_period)
            if is_undersampled
            else "rig must be known well enough for its motion to be followed, but some systems that its guess allows "
            f"run away between two samples; give a narrower guess or a shorter step than {rig.step!r} s"
        )
    return ExperimentDesign(
        rig,
        policy,
        u * belief.scales.input,
        _predicted_output_quantiles(belief, futures, limit, u),
        belief,
        _expected_stds(belief, systems, covs),
        log_det_gain + 0.5 * float(np.linalg.slogdet(belief.coefficients_cov)[1]),
        block.scale,
        block.exit_probability,
        samples_per_period,
    )


def _optimised_block(
    planner: EfePlanner,
    env_view: EnvView,
    view: ModelView,
    systems: SampledSystems,
    futures: MonteCarloSystems,
    bound: float,
    seed: int,
    on_progress: ProgressCallback,
) -> ScaledBlock:
    """The planner's block, optimised from noise signals and from the plan for the belief's means."""
    samples = env_view.horizon
    n_noise_starts = min(max(_NOISE_START_SAMPLES // samples, _MIN_NOISE_STARTS), _MAX_NOISE_STARTS)
    record = _belief_record_at_rest(env_view.belief)
    starting_inputs = initial_guesses(planner.settings, record, samples, seed, n_noise_starts)
    return ScaledBlock(
        *optimise_block(view, systems, futures, starting_inputs, float(env_view.max_inputs[0]), bound, tell=on_progress)
    )


def _best_rollout(
    policy: str,
    env_view: EnvView,
    view: ModelView,
    systems: SampledSystems,
    futures: MonteCarloSystems,
    bound: float,
    seed: int,
    on_progress: ProgressCallback,
) -> ScaledBlock:
    """The inputs of a policy on some of the drawn systems, of which those with the most expected information."""
    rollouts = [
        _roll_out_policy(
            policy, env_view, futures, k, bound, seed, lambda part, k=k: on_progress((k + part) / _N_ROLLOUTS)
        )
        for k in range(_N_ROLLOUTS)
    ]
    limit = float(env_view.experiment.max_output)
    information = [expected_information(view, systems, limit, block.inputs)[0] for block in rollouts]
    return rollouts[int(np.argmax(information))]


def _predicted_output_quantiles(belief: Belief, futures: MonteCarloSystems, limit: float, u: FloatArray) -> FloatArray:
    """Quantiles (3, T) of the output that is predicted for inputs, in the sensor's unit."""
    outputs = futures.simulate_outputs(u, slice(_N_PREDICTED_SYSTEMS))
    outputs = np.clip(np.nan_to_num(outputs, nan=2 * limit), -2 * limit, 2 * limit)  # a system may run away
    quantiles: FloatArray = belief.scales.output * np.quantile(outputs, _OUTPUT_QUANTILES, axis=0)
    return quantiles


def undersampling_message(step: float, samples_per_period: float) -> str:
    """The message for a sampling step [s] at which a period has too few samples."""
    return (
        f"step must be at most 1/{MIN_SAMPLES_PER_PERIOD:g} of a period, but is {step:g} s: the belief has "
        f"{samples_per_period:.1f} samples in a period; sample faster, {RECOMMENDED_SAMPLES_PER_PERIOD} at least"
    )


def _expected_stds(belief: Belief, systems: SampledSystems, covs: FloatArray) -> dict[str, float]:
    """Parameter to its standard deviation under these covariances, the median over systems."""
    parameter_covs = [
        propagate_to_physical(belief.model, c, cov, belief.scales)[1]
        for c, cov in zip(systems.coefficients, covs, strict=True)
    ]
    stds = np.median(np.sqrt([np.diag(cov) for cov in parameter_covs]), axis=0)
    return dict(zip(belief.parameters(), stds.tolist(), strict=True))


def _belief_record_at_rest(belief: Belief) -> FloatArray:
    """The record of a belief with its state at rest."""
    n, places, record = belief.model.n_states, covariance_indices(belief.model), belief.record.copy()
    record[:n] = 0.0
    record[0] = equilibria(belief.model, belief.coefficients_mean)[0]
    record[places[:n]] = 0.0
    record[np.diag(places)[:n]] = _REST_STD**2
    return record


class _SampledPlant:
    """A drawn system as the plant of ``Rig-v0``, in the rig's units."""

    def __init__(self, env_view: EnvView, futures: MonteCarloSystems, system: int) -> None:
        self._scales, self._model = env_view.experiment.scales, futures.model
        self._system = futures.coefficients[system], futures.states[system]
        self._noises = tuple(noise[system] for noise in futures.disturbances(env_view.horizon))
        self._interpolation = futures.interpolation
        self._inputs: list[float] = []

    def reset(self) -> None:
        self._inputs = []

    def step(self, u: float) -> float:
        self._inputs.append(u / self._scales.input)
        t, (coefficients, state) = len(self._inputs), self._system
        noisy_inputs = np.array(self._inputs) + self._noises[0][:t]
        y = free_run(self._model, coefficients, noisy_inputs, state, self._interpolation)[-1]
        return float(self._scales.output * (y + self._noises[1][t - 1]))


def _roll_out_policy(
    policy_name: str,
    env_view: EnvView,
    futures: MonteCarloSystems,
    system: int,
    bound: float,
    seed: int,
    on_progress: ProgressCallback,
) -> ScaledBlock:
    """The inputs of a policy on a drawn system, scaled down until they are safe on all systems."""
    import gymnasium as gym

    import duffing_env  # noqa: F401  registers the tracks

    experiment = env_view.experiment
    env = gym.make(
        "duffing_env/Rig-v0", rig=experiment.rig, prior=experiment.prior, horizon=env_view.horizon,
        plant=_SampledPlant(env_view, futures, system),
    )  # fmt: skip
    policy = make_policy(policy_name, env, seed=seed)
    observation, _ = env.reset()
    u, state, episode_start = np.zeros(env_view.horizon), None, np.ones(1, dtype=bool)
    for t in range(env_view.horizon):
        on_progress(t / env_view.horizon)
        with attribute_user_errors(policy_name, "policy"):
            action, state = policy.predict(observation, state, episode_start, deterministic=True)
        episode_start = np.zeros(1, dtype=bool)
        observation, _, terminated, truncated, _ = env.step(action)
        u[t] = env_view.max_inputs[0] * float(action[0])
        if terminated or truncated:
            break
    scale, probability = futures.safe_scale(u, bound)
    return ScaledBlock(scale * u, scale, probability)
