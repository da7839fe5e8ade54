"""The next experiment on a rig, as a whole: a signal, and what is to be expected after it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.special import ndtri

from agents.loading import of_ones_own
from agents.planner.blocks import MOST_PLANNED, best_block, drafts, expected, systems_of
from agents.planner.futures import Futures, drawn_at_rest, draws_for, rests
from agents.planner.mean_design import Systems
from agents.planner.motion import View, frequency
from agents.planner.policy import Planner
from agents.policies import make_policy
from agents.policies.signals import SignalPolicy
from agents.running.blocks import Block, SignalDesign
from agents.running.observed import Observed
from estimator.belief import Belief, covariance_places
from estimator.checks import MOST_SEED, SMALLEST, number, whole
from estimator.files import write_atomically
from estimator.free_run import free_run
from estimator.identification.checks import ENOUGH, SLOWEST
from estimator.identification.columns import headed, unit_of
from estimator.parameters import FloatArray
from estimator.physical import propagate
from estimator.progress import Tell, untold
from estimator.rig import Rig
from estimator.rig_prior import rig_prior

#: Samples of an experiment, which is planned as a whole.
_MOST = 2**16

#: Candidates of noise from which the planner climbs: under a wide belief, summits are nats apart. Long signals have
#: fewer, because each takes long to climb: so many samples in all, and between these numbers.
_NOISE_SAMPLES, _FEWEST_NOISES, _MOST_NOISES = 4096, 2, 14

#: Systems on which a policy that answers to outputs is played.
_PLAYED = 4

#: Systems whose outputs are looked at beforehand, and which of their quantiles: a band of 90 %, and its middle.
_SHOWN, _QUANTILES = 200, (0.05, 0.5, 0.95)

#: Standard deviation of a state at rest, where the planner's plan for the belief's means begins, in parts of its scale.
_STILL = 1e-3


@dataclass(frozen=True, eq=False)
class Designed:
    """An experiment to come.

    Attributes:
        rig: it is for.
        policy: that chose it.
        u: (T,) inputs in the rig's unit.
        shown: (3, T) what the sensor is expected to show, in its unit: the 5 %, 50 % and 95 % quantiles over the
            belief, cut at twice the range.
        before: what is believed now.
        after: parameter to the standard deviation that is to be expected after it: the median over the belief.
        gain: nats that the coefficients are expected to gain.
        share: of what the policy chose that is safe.
        probability: at most that of leaving the range, under the belief (`agents.planner.futures.Futures.chance`).
        samples_in_period: samples in a period of small motions, as they are believed.
    """

    rig: Rig
    policy: str
    u: FloatArray
    shown: FloatArray
    before: Belief
    after: Mapping[str, float]
    gain: float
    share: float
    probability: float
    samples_in_period: float

    def rows(self, level: float = 0.9) -> list[tuple[str, float, tuple[float, float], float, str]]:
        """Of each parameter: name, mean, its interval now, the half width of that to be expected, and the unit."""
        wide, intervals = float(ndtri(0.5 + level / 2)), self.before.interval(level)
        return [
            (name, mean, intervals[name], wide * self.after[name], unit)
            for name, (mean, _, unit) in self.before.parameters().items()
        ]

    def write(self, path: Path) -> None:
        """A CSV file with time [s] and the input, as `identify` reads them beside an output."""
        name = headed(self.rig.input.column or "u", self.rig.input.unit)
        lines = [f"time [s],{name if unit_of(name) else f'{name} [{self.rig.input.unit}]'}"]
        lines += [f"{k * self.rig.step:.9g},{value:.12g}" for k, value in enumerate((self.u + 0.0).tolist())]
        write_atomically(path, "\n".join(lines) + "\n")


def design(
    rig: Rig | Mapping[str, Any] | str | Path,
    prior: Belief | None = None,
    policy: str = "efe",
    samples: int = 256,
    bound: float = 0.05,
    seed: int = 0,
    tell: Tell = untold,
) -> Designed:
    """Design the next experiment: a signal for an oscillator at rest.

    ``efe`` climbs what is learned of systems drawn from the belief, on average (`agents.planner.blocks`). A policy that
    answers to outputs is played on some of them, and the signal that tells most on average is taken. A signal is taken
    as it is. What would leave the range with more than the bound is made smaller.

    Args:
        rig: with the limit of the input and the range of the output.
        prior: what is believed, such as ``identify(...).belief``; the rig's guess where it is None.
        policy: any that `agents.policies.make_policy` knows.
        samples: of the experiment.
        bound: of the probability that the output leaves its range, under the whole belief.
        seed: of the policy, and of the systems that are drawn.
        tell: is told the share that is done (`estimator.progress.progress`).

    Raises:
        ValueError: for a rig without limit or range, or without guess where there is no prior; a prior in other
            scales; samples below 8 or above 65,536; a bound that is not a probability; where even no input is safe; or
            a step that is too long for the motion to be followed.

    Example:
        >>> from agents.running.experiment import design
        >>> from estimator import Channel, Rig
        >>> rig = Rig(1e-3, input=Channel("N", limit=20.0, noise=0.02), output=Channel("m", range=0.03, noise=5e-6),
        ...           guess={"m": (0.3, 0.5), "c": (0.1, 2.0), "a": (1e3, 5e3), "b": (0.0, 1e8)})
        >>> found = design(rig, policy="prbs", samples=256)
        >>> name, mean, (low, high), half, unit = found.rows()[0]
        >>> bool(half < (high - low) / 2), unit, found.probability < 0.05, len(found.u)
        (True, 'kg', True, 256)
    """
    whole("samples", samples, _MOST, 8)
    number("bound", bound, SMALLEST, 1 - SMALLEST, "0.05 is usual")
    whole("seed", seed, MOST_SEED, 0)
    rig = Rig.of(rig)
    belief = rig_prior(rig) if prior is None else prior
    observed = Observed(rig, belief, int(samples))
    rng = np.random.default_rng(seed)
    view, limit = View.of(observed.experiment), float(observed.experiment.max_output)
    drawn = drawn_at_rest(belief, rng, draws_for(bound, MOST_PLANNED))
    futures = Futures(view.model, drawn, limit, rng, max(0, rig.whole_delay), view.degree)
    systems = systems_of(view, belief, futures, int(samples))
    with of_ones_own(policy, "policy"):
        chooser = make_policy(policy, observed, seed=seed)  # type: ignore[arg-type]
    if isinstance(chooser, Planner):
        noises = min(max(_NOISE_SAMPLES // int(samples), _FEWEST_NOISES), _MOST_NOISES)
        begun = drafts(chooser, _at_rest(belief), int(samples), seed, noises)
        u, share, probability = best_block(view, systems, futures, begun, observed.max_input, bound, tell=tell)
    elif isinstance(chooser, SignalPolicy):
        u, share, probability = SignalDesign(chooser, observed).block(int(samples), futures, bound)
    else:
        found = [
            _played(policy, observed, futures, k, bound, seed, lambda part, k=k: tell((k + part) / _PLAYED))
            for k in range(_PLAYED)
        ]
        told = [expected(view, systems, limit, u)[0] for u, *_ in found]
        u, share, probability = found[int(np.argmax(told))]
    in_period = 1 / frequency(belief)
    if share == 0.0 and probability >= bound:
        raise ValueError(
            too_slow(rig.step, in_period) if in_period < SLOWEST else
            f"rig must be known well enough to stay in its range, but even without input it leaves it with probability "
            f"{probability:.2g}, and at most {bound:.2g} is allowed; give a narrower guess or a wider range"
        )  # fmt: skip
    u = np.clip(u, -observed.max_input, observed.max_input)
    worth, covs = expected(view, systems, limit, u)
    if not (np.isfinite(worth) and np.isfinite(covs).all()):
        raise ValueError(
            too_slow(rig.step, in_period) if in_period < SLOWEST else
            "rig must be known well enough for its motion to be followed, but some systems that its guess allows run "
            f"away between two samples; give a narrower guess or a shorter step than {rig.step!r} s"
        )  # fmt: skip
    gain = worth + 0.5 * float(np.linalg.slogdet(belief.coefficients_cov)[1])
    after = _expected_deviations(belief, systems, covs)
    outputs = futures.shown(u, slice(_SHOWN))
    outputs = np.clip(np.nan_to_num(outputs, nan=2 * limit), -2 * limit, 2 * limit)  # a system may run away
    shown = belief.scales.output * np.quantile(outputs, _QUANTILES, axis=0)
    return Designed(rig, policy, u * belief.scales.input, shown, belief, after, gain, share, probability, in_period)


def too_slow(step: float, in_period: float) -> str:
    """What to say of a step [s] at which there are so many samples in a period."""
    return (
        f"step must be at most 1/{SLOWEST:g} of a period, but is {step:g} s: as believed now, there are "
        f"{in_period:.1f} samples in a period; sample faster, {ENOUGH} at least"
    )


def _expected_deviations(belief: Belief, systems: Systems, covs: FloatArray) -> dict[str, float]:
    """Parameter to the median over systems of its standard deviation with these covariances."""
    found = [
        propagate(belief.model, c, cov, belief.scales)[1] for c, cov in zip(systems.coefficients, covs, strict=True)
    ]
    stds = np.median(np.sqrt([np.diag(cov) for cov in found]), axis=0)
    return dict(zip(belief.parameters(), stds.tolist(), strict=True))


def _at_rest(belief: Belief) -> FloatArray:
    """A belief's record, with the state at rest."""
    n, places, record = belief.model.n_states, covariance_places(belief.model), belief.record.copy()
    record[:n] = 0.0
    record[0] = rests(belief.model, belief.coefficients_mean)[0]
    record[places[:n]] = 0.0
    record[np.diag(places)[:n]] = _STILL**2
    return record


class _Imagined:
    """A drawn system as the plant of ``Rig-v0``, in the rig's units."""

    def __init__(self, observed: Observed, futures: Futures, k: int) -> None:
        self._scales, self._model = observed.experiment.scales, futures.model
        self._system = futures.coefficients[k], futures.states[k]
        self._noises = tuple(noise[k] for noise in futures.disturbances(observed.horizon))
        self._interpolation = futures.interpolation
        self._inputs: list[float] = []

    def reset(self) -> None:
        self._inputs = []

    def step(self, u: float) -> float:
        self._inputs.append(u / self._scales.input)
        t, (coefficients, state) = len(self._inputs), self._system
        acting = np.array(self._inputs) + self._noises[0][:t]
        y = free_run(self._model, coefficients, acting, state, self._interpolation)[-1]
        return float(self._scales.output * (y + self._noises[1][t - 1]))


def _played(name: str, observed: Observed, futures: Futures, k: int, bound: float, seed: int, tell: Tell) -> Block:
    """What a policy answers to a drawn system, as large as it is safe on all."""
    import gymnasium as gym

    import duffing_env  # noqa: F401  registers the tracks

    experiment = observed.experiment
    env = gym.make(
        "duffing_env/Rig-v0", rig=experiment.rig, prior=experiment.prior, horizon=observed.horizon,
        plant=_Imagined(observed, futures, k),
    )  # fmt: skip
    policy = make_policy(name, env, seed=seed)
    observation, _ = env.reset()
    u, state, begins = np.zeros(observed.horizon), None, np.ones(1, dtype=bool)
    for t in range(observed.horizon):
        tell(t / observed.horizon)
        with of_ones_own(name, "policy"):
            action, state = policy.predict(observation, state, begins, deterministic=True)
        begins = np.zeros(1, dtype=bool)
        observation, _, terminated, truncated, _ = env.step(action)
        u[t] = observed.max_input * float(action[0])
        if terminated or truncated:
            break
    share, probability = futures.share(u, bound)
    return share * u, share, probability
