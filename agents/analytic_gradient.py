"""Analytic policy gradient: a policy network climbs the Fisher information of its own roll-outs, by exact derivatives.

A policy gradient of PPO is estimated from returns. Here the simulated plant is known, and ∂J/∂u_t of an episode's worth
J (`agents.design`) follows from one backward pass along the displacements that were seen: it counts what the input
does to the next displacements and to their sensitivities, with the noise and all later inputs as they were. The network
is moved along Σ_t ∂J/∂u_t ∇u(o_t), over all observations o_t that it met.

Derivatives along a strongly driven oscillator grow with their reach, so they fade: what an input does to the state k
samples later counts ``fading``^k. Displacements beyond ``aim`` of the limit cost a penalty. What a later input
of the network does about an earlier one is left out, and so is what an input does to the belief's means.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from agents.design import START_SIZE, descend, half_log_det, invert, retrace
from duffing_env.layout import OBSERVATION
from estimator.fisher import as_rows
from estimator.lanes import kernel
from estimator.parameters import to_coefficients

if TYPE_CHECKING:
    from stable_baselines3 import PPO

    from duffing_env.vector_env import DuffingVectorEnv

FloatArray = npt.NDArray[np.float64]

# Places in the observation.
_STATE, _LAST_INPUT = (list(OBSERVATION).index(name) for name in ("state_x0", "last_input"))

#: Longest gradient of a minibatch by the weights.
_LARGEST_STEP = 0.3


@dataclass(frozen=True)
class AscentSettings:
    """How far a network climbs the information by exact derivatives, before it learns from returns."""

    updates: int = 0
    """Batches of episodes to climb on; 0 for none."""
    num_envs: int = 128
    """Episodes of a batch."""
    minibatches: int = 8
    """Gradient steps on a batch."""
    learning_rate: float = 5e-4
    """Step size (Adam) at the start; it falls linearly to 0."""
    fading: float = 0.93
    """What an input does to the state counts so much less with every sample that passes; 1 is exact."""
    aim: float = 0.97
    """Displacements beyond this part of the limit cost a penalty."""
    penalty: float = 300.0
    """Nats for a displacement of twice ``aim``; it grows with the square of the excess."""
    largest: float = 1.0
    """Derivatives by the action are cut to this size [nats]."""

    def __post_init__(self) -> None:
        if self.updates < 0:
            raise ValueError(f"updates must be at least 0, but is {self.updates}; 0 is no ascent")
        for name in ("num_envs", "minibatches"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1, but is {getattr(self, name)}; updates=0 is no ascent")
        for name in ("learning_rate", "largest"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} must be positive, but is {getattr(self, name)}")
        if not 0 <= self.fading <= 1:
            raise ValueError(f"fading must be in [0, 1], but is {self.fading}; 1 is exact, and noisy")
        if not 0 < self.aim <= 1:
            raise ValueError(f"aim must be in (0, 1], but is {self.aim}; it is a part of the displacement limit")
        if not 0 <= self.penalty < np.inf:
            raise ValueError(f"penalty must be 0 or more and finite, but is {self.penalty}")


def ascend_policy(
    model: PPO,
    env_id: str,
    options: dict[str, Any],
    settings: AscentSettings,
    seed: int,
    on_progress: Callable[[int, float], None] | None = None,
) -> None:
    """Move the actor of a model up the information of its roll-outs; critic and exploration stay as they are.

    The same seed gives the same weights, with one thread of torch. The global generator of torch is not used.

    Args:
        model: PPO on the track; its actor is changed in place.
        env_id: the track.
        options: of the environment.
        settings: how far; with ``updates=0`` nothing happens.
        seed: of systems, noise and minibatches.
        on_progress: called after each update with its number and the mean gain of information ½ log det(Λ0 + F) of
            its episodes over the prior's [nats].

    Raises:
        ValueError: where the track does not simulate the difference equation with one truth for an episode.
    """
    import torch

    from agents.actor import Actor, turned
    from agents.evaluation import make

    if settings.updates == 0:
        return
    envs = make(env_id, settings.num_envs, options)
    experiment: Any = envs.experiment
    if type(experiment).__name__ != "SimulatedExperiment" or experiment.jump:
        raise ValueError(
            f"env must simulate the difference equation without a jump, but is {env_id}; leave updates at 0 there"
        )
    actor, rng = Actor(model), np.random.default_rng([seed, 2])
    envs.reset(seed=seed)
    prior = np.linalg.inv(envs.belief(0).coefficients_cov).astype(np.float64)
    optimiser = torch.optim.Adam(actor.parameters, settings.learning_rate, betas=(0.9, 0.99))
    with actor.standardised(_roll_out(envs, actor.act).observations) as standard:
        for k in range(settings.updates):
            optimiser.param_groups[0]["lr"] = settings.learning_rate * (1 - k / settings.updates)
            episodes = _roll_out(envs, lambda observations: actor.act(standard(observations)))
            gradients, worth = _differentiate(episodes, experiment, prior, settings)
            observations = episodes.observations
            for chosen in np.array_split(rng.permutation(len(observations)), settings.minibatches):
                some, signs = turned(observations[chosen], rng)
                toward = torch.from_numpy(signs * gradients[chosen])
                loss = -(toward * actor(torch.from_numpy(standard(some)))).mean()
                optimiser.zero_grad()
                loss.backward()
                torch.nn.utils.clip_grad_norm_(actor.parameters, _LARGEST_STEP)
                optimiser.step()
            if on_progress is not None:
                on_progress(k + 1, worth - 0.5 * float(np.linalg.slogdet(prior)[1]))
    envs.close()


@dataclass(frozen=True)
class _Episodes:
    """One episode of each of n environments, T samples at most.

    Attributes:
        theta: (n, 4) the true coefficients.
        lengths: (n,) samples until the end.
        all_observations: (n, T, features) before each sample.
        means: (n, T) of the action, not clipped.
        inputs: (n, T) [V].
        displacements: (n, T + 1) as filtered, from before the first sample on [V].
    """

    theta: FloatArray
    lengths: npt.NDArray[np.int64]
    all_observations: npt.NDArray[np.float32]
    means: npt.NDArray[np.float32]
    inputs: FloatArray
    displacements: FloatArray

    @property
    def played(self) -> npt.NDArray[np.bool_]:
        """(n, T) which samples came before the end."""
        return np.arange(self.means.shape[1]) < self.lengths[:, None]

    @property
    def observations(self) -> npt.NDArray[np.float32]:
        """(samples, features) of those that were played."""
        return self.all_observations[self.played]


def _roll_out(envs: DuffingVectorEnv, act: Callable[[npt.NDArray[np.float32]], npt.NDArray[np.float32]]) -> _Episodes:
    """One episode of every environment, by the mean of the action."""
    n, T = envs.num_envs, envs.horizon
    observations, _ = envs.reset()
    theta = as_rows(to_coefficients(envs.truth))
    seen = np.zeros((n, T, observations.shape[1]), dtype=np.float32)
    means = np.zeros((n, T), dtype=np.float32)
    inputs, displacements = np.zeros((n, T)), np.zeros((n, T + 1))
    lengths, running = np.full(n, T), np.ones(n, dtype=np.bool_)
    for t in range(T):
        seen[:, t] = observations
        means[:, t] = act(observations)
        observations, _, terminated, truncated, _ = envs.step(np.clip(means[:, t : t + 1], -1.0, 1.0))
        inputs[:, t] = envs.max_input * observations[:, _LAST_INPUT]
        displacements[:, t + 1] = envs.experiment.max_output * observations[:, _STATE]
        finished = running & (terminated | truncated)
        lengths[finished] = t + 1
        running &= ~finished
        if not running.any():
            break
    return _Episodes(theta, lengths, seen, means, inputs, displacements)


def _differentiate(
    episodes: _Episodes, experiment: Any, prior: FloatArray, settings: AscentSettings
) -> tuple[npt.NDArray[np.float32], float]:
    """Derivatives (samples,) of the worth by the actions that were played [nats], and the mean worth [nats]."""
    gradients, worths = np.zeros(episodes.means.shape), np.empty(len(episodes.means))
    q, r = experiment.process_noise**2, experiment.measurement_noise**2
    differentiate(
        episodes.theta, prior, q, r, settings.aim * experiment.max_output, settings.penalty, settings.fading,
        episodes.lengths, episodes.displacements, episodes.inputs, gradients, worths,
    )  # fmt: skip
    gradients = np.clip(experiment.max_input * gradients, -settings.largest, settings.largest)
    # A mean beyond the largest input is not pushed further out, because nothing would come of it.
    gradients[(np.abs(episodes.means) > 1) & (gradients * episodes.means > 0)] = 0.0
    return gradients[episodes.played].astype(np.float32), float(worths.mean())


@kernel
def differentiate(theta, precision, q, r, limit, penalty, fading, lengths, displacements, inputs, gradients, worths):
    """Derivatives of the worth of n episodes by their inputs, along the displacements that were seen.

    Args:
        theta: (n, 4) the true coefficients.
        precision: (4, 4) Λ0.
        q: variance of the process noise [V²].
        r: variance of the measurement noise [V²].
        limit: displacement beyond which the penalty begins [V].
        penalty: see `agents.design`.
        fading: see `agents.design.descend`.
        lengths: (n,) samples of the episodes.
        displacements: (n, T + 1) [V].
        inputs: (n, T) [V].
        gradients: (n, T) receives the derivatives [nats/V], 0 after the end.
        worths: (n,) receives ½ log det(Λ0 + F) [nats].
    """
    T = inputs.shape[1]
    tape = np.empty((T + 1, START_SIZE))
    F, G = np.empty((4, 4)), np.empty((4, 4))
    for i in range(len(inputs)):
        length = lengths[i]
        retrace(theta[i], q, r, displacements[i, : length + 1], inputs[i, :length], tape, F)
        for j in range(4):
            for k in range(j + 1):
                F[j, k] += precision[j, k]
        worths[i] = half_log_det(F)
        invert(F, G)
        descend(theta[i], q, r, limit, penalty, fading, length, inputs[i], tape, G, gradients[i])
