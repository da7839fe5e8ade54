"""The next experiment on a rig, as a whole: a signal, and what is to be expected after it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.special import ndtri

from agents.hardware.block_loop import ScaledBlock, SignalBlockDesigner
from agents.hardware.env_view import EnvView
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
from estimator.identification.data.column_names import name_with_unit, unit_in_name
from estimator.identification.diagnostics.record_checks import MIN_SAMPLES_PER_PERIOD, RECOMMENDED_SAMPLES_PER_PERIOD
from estimator.inference.free_run import free_run
from estimator.rigs.physical_parameters import propagate_to_physical
from estimator.rigs.rig import Rig
from estimator.rigs.rig_prior import rig_prior
from estimator.support.argument_checks import MAX_SEED, MIN_MAGNITUDE, check_integer, check_number
from estimator.support.array_types import FloatArray
from estimator.support.file_io import write_atomically
from estimator.support.progress import ProgressCallback, ignore_progress

#: Samples of an experiment, which is planned as a whole.
_MAX_SAMPLES = 2**16

#: Candidates of noise from which the planner climbs: under a wide belief, summits are nats apart. Long signals have
#: fewer, because each takes long to climb: so many samples in all, and between these numbers.
_NOISE_START_SAMPLES, _MIN_NOISE_STARTS, _MAX_NOISE_STARTS = 4096, 2, 14

#: Systems on which a policy that answers to outputs is played.
_N_ROLLOUTS = 4

#: Systems whose outputs are looked at beforehand, and which of their quantiles: a band of 90 %, and its middle.
_N_PREDICTED_SYSTEMS, _OUTPUT_QUANTILES = 200, (0.05, 0.5, 0.95)

#: Standard deviation of a state at rest, where the planner's plan for the belief's means begins, in parts of its scale.
_REST_STD = 1e-3


@dataclass(frozen=True, eq=False)
class ExperimentDesign:
    """An experiment to come.

    Attributes:
        rig: it is for.
        policy: that chose it.
        u: (T,) inputs in the rig's unit.
        shown: (3, T) what the sensor is expected to show, in its unit: the 5 %, 50 % and 95 % quantiles over the
            belief, cut at twice the range.
        prior: what is believed now.
        expected_stds: parameter to the standard deviation that is to be expected after it: the median over the belief.
        information_gain: nats that the coefficients are expected to gain.
        share: of what the policy chose that is safe.
        exit_probability: at most that of leaving the range, under the belief (`agents.planning.open_loop.posterior_samples.MonteCarloSystems.chance`).
        samples_per_period: samples in a period of small motions, as they are believed.
    """

    rig: Rig
    policy: str
    u: FloatArray
    shown: FloatArray
    prior: Belief
    expected_stds: Mapping[str, float]
    information_gain: float
    share: float
    exit_probability: float
    samples_per_period: float

    def parameter_rows(self, level: float = 0.9) -> list[tuple[str, float, tuple[float, float], float, str]]:
        """Of each parameter: name, mean, its interval now, the half width of that to be expected, and the unit."""
        normal_quantile, intervals = float(ndtri(0.5 + level / 2)), self.prior.interval(level)
        return [
            (name, mean, intervals[name], normal_quantile * self.expected_stds[name], unit)
            for name, (mean, _, unit) in self.prior.parameters().items()
        ]

    def write(self, path: Path) -> None:
        """A CSV file with time [s] and the input, as `identify` reads them beside an output."""
        name = name_with_unit(self.rig.input.column or "u", self.rig.input.unit)
        lines = [f"time [s],{name if unit_in_name(name) else f'{name} [{self.rig.input.unit}]'}"]
        lines += [f"{k * self.rig.step:.9g},{value:.12g}" for k, value in enumerate((self.u + 0.0).tolist())]
        write_atomically(path, "\n".join(lines) + "\n")


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

    ``efe`` climbs what is learned of systems drawn from the belief, on average (`agents.planning.open_loop.chance_constrained_block`). A policy that
    answers to outputs is played on some of them, and the signal that tells most on average is taken. A signal is taken
    as it is. What would leave the range with more than the bound is made smaller.

    Args:
        rig: with the limit of the input and the range of the output.
        prior: what is believed, such as ``identify(...).belief``; the rig's guess where it is None.
        policy: any that `agents.policies.make_policy` knows.
        samples: of the experiment.
        bound: of the probability that the output leaves its range, under the whole belief.
        seed: of the policy, and of the systems that are drawn.
        on_progress: is told the share that is done (`estimator.support.progress.show_progress`).

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
        >>> name, mean, (low, high), half, unit = found.rows()[0]
        >>> bool(half < (high - low) / 2), unit, found.probability < 0.05, len(found.u)
        (True, 'kg', True, 256)
    """
    check_integer("samples", samples, _MAX_SAMPLES, 8)
    check_number("bound", bound, MIN_MAGNITUDE, 1 - MIN_MAGNITUDE, "0.05 is usual")
    check_integer("seed", seed, MAX_SEED, 0)
    rig = Rig.from_any(rig)
    belief = rig_prior(rig) if prior is None else prior
    env_view = EnvView(rig, belief, int(samples))
    rng = np.random.default_rng(seed)
    view, limit = ModelView.of(env_view.experiment), float(env_view.experiment.max_output)
    posterior_draws = draw_at_rest(belief, rng, required_draws(bound, MAX_PLANNED_DRAWS))
    futures = MonteCarloSystems(view.model, posterior_draws, limit, rng, max(0, rig.integer_delay), view.degree)
    systems = sampled_systems(view, belief, futures, int(samples))
    with attribute_user_errors(policy, "policy"):
        policy_object = make_policy(policy, env_view, seed=seed)  # type: ignore[arg-type]
    if isinstance(policy_object, EfePlanner):
        n_noise_starts = min(max(_NOISE_START_SAMPLES // int(samples), _MIN_NOISE_STARTS), _MAX_NOISE_STARTS)
        starting_inputs = initial_guesses(
            policy_object.settings, _belief_record_at_rest(belief), int(samples), seed, n_noise_starts
        )
        u, scale, probability = optimise_block(
            view, systems, futures, starting_inputs, env_view.max_input, bound, tell=on_progress
        )
    elif isinstance(policy_object, SignalPolicy):
        u, scale, probability = SignalBlockDesigner(policy_object, env_view).block(int(samples), futures, bound)
    else:
        rollouts = [
            _roll_out_policy(
                policy, env_view, futures, k, bound, seed, lambda part, k=k: on_progress((k + part) / _N_ROLLOUTS)
            )
            for k in range(_N_ROLLOUTS)
        ]
        information = [expected_information(view, systems, limit, u)[0] for u, *_ in rollouts]
        u, scale, probability = rollouts[int(np.argmax(information))]
    samples_per_period = 1 / believed_resonance(belief)
    if scale == 0.0 and probability >= bound:
        raise ValueError(
            undersampling_message(rig.step, samples_per_period) if samples_per_period < MIN_SAMPLES_PER_PERIOD else
            f"rig must be known well enough to stay in its range, but even without input it leaves it with probability "
            f"{probability:.2g}, and at most {bound:.2g} is allowed; give a narrower guess or a wider range"
        )  # fmt: skip
    u = np.clip(u, -env_view.max_input, env_view.max_input)
    log_det_gain, covs = expected_information(view, systems, limit, u)
    if not (np.isfinite(log_det_gain) and np.isfinite(covs).all()):
        raise ValueError(
            undersampling_message(rig.step, samples_per_period) if samples_per_period < MIN_SAMPLES_PER_PERIOD else
            "rig must be known well enough for its motion to be followed, but some systems that its guess allows run "
            f"away between two samples; give a narrower guess or a shorter step than {rig.step!r} s"
        )  # fmt: skip
    gain = log_det_gain + 0.5 * float(np.linalg.slogdet(belief.coefficients_cov)[1])
    expected_stds = _expected_stds(belief, systems, covs)
    outputs = futures.simulate_outputs(u, slice(_N_PREDICTED_SYSTEMS))
    outputs = np.clip(np.nan_to_num(outputs, nan=2 * limit), -2 * limit, 2 * limit)  # a system may run away
    output_quantiles = belief.scales.output * np.quantile(outputs, _OUTPUT_QUANTILES, axis=0)
    return ExperimentDesign(
        rig,
        policy,
        u * belief.scales.input,
        output_quantiles,
        belief,
        expected_stds,
        gain,
        scale,
        probability,
        samples_per_period,
    )


def undersampling_message(step: float, samples_per_period: float) -> str:
    """What to say of a step [s] at which there are so many samples in a period."""
    return (
        f"step must be at most 1/{MIN_SAMPLES_PER_PERIOD:g} of a period, but is {step:g} s: as believed now, there are "
        f"{samples_per_period:.1f} samples in a period; sample faster, {RECOMMENDED_SAMPLES_PER_PERIOD} at least"
    )


def _expected_stds(belief: Belief, systems: SampledSystems, covs: FloatArray) -> dict[str, float]:
    """Parameter to the median over systems of its standard deviation with these covariances."""
    parameter_covs = [
        propagate_to_physical(belief.model, c, cov, belief.scales)[1]
        for c, cov in zip(systems.coefficients, covs, strict=True)
    ]
    stds = np.median(np.sqrt([np.diag(cov) for cov in parameter_covs]), axis=0)
    return dict(zip(belief.parameters(), stds.tolist(), strict=True))


def _belief_record_at_rest(belief: Belief) -> FloatArray:
    """A belief's record, with the state at rest."""
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
    """What a policy answers to a drawn system, as large as it is safe on all."""
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
        u[t] = env_view.max_input * float(action[0])
        if terminated or truncated:
            break
    scale, probability = futures.safe_scale(u, bound)
    return scale * u, scale, probability
