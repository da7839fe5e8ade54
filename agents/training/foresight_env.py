"""Environments as a policy with foresight sees them, for Stable-Baselines3; and rewards that count what is to come."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
import numpy.typing as npt
from stable_baselines3.common.vec_env import VecEnvWrapper
from stable_baselines3.common.vec_env.base_vec_env import VecEnvObs, VecEnvStepReturn

from agents.evaluation.batch import make
from agents.policies import make_policy
from agents.policies.foresight import CommonForesight, Foresight
from agents.policies.prospects import BOUND, EXPECTED
from agents.vec_env import DuffingVecEnv
from duffing_env.vector_env import DuffingVectorEnv
from estimator.belief import Belief
from estimator.parameters import FloatArray

#: Rewards on a track are scaled to returns of about 1, where a critic begins.
SCALE = 5.0

#: Systems whose episodes show how much a sample brings.
_EXAMPLES = 64

# Its place in the features; what is expected stands behind the observation, which is longer or shorter by the model.
_BEST = EXPECTED.index("best_up_4") - len(EXPECTED)


class ForesightVecEnv(VecEnvWrapper):
    """A `DuffingVecEnv` whose observations are features, and whose rewards tell early what they are worth at the end.

    To the reward comes the increase of Ψ = ½ log det(I + C J), with C the covariance of the belief's coefficients and
    J the information that the rest of the episode will bring at an average rate; Ψ is 0 when the episode has ended.
    It is a difference of potentials, so without a discount no policy gains by it (Ng, Harada and Russell 1999): over an
    episode it adds up to the same number for all. But without it most information is gained in the first samples of an
    episode, whatever the input, and the rest weighs little; with it a sample weighs what it adds to what is known *at
    the end*.

    The end of an episode is an end, by time too: there is nothing to gain after it, and the features show it coming.

    Args:
        venv: the environments, with any input between the limits as an action.
        foresight: what they are seen with.
        levels: as of `DuffingVecEnv`; with a choice, an odd number of them has none as one.
        in_nats: whether the reward counts information, so that Ψ is added to it.
    """

    def __init__(
        self, venv: DuffingVecEnv, foresight: Foresight | CommonForesight, levels: int = 0, *, in_nats: bool = True
    ) -> None:
        self.foresight = foresight
        self._weight = np.float32(in_nats)
        self._levels = np.linspace(-1.0, 1.0, levels) if levels else None
        space = gym.spaces.Box(-BOUND, BOUND, (foresight.features,), np.float32)
        super().__init__(venv, space, gym.spaces.Discrete(levels) if levels else venv.action_space)

    def reset(self) -> VecEnvObs:
        """Start an episode in every row."""
        return self._see(self.venv.reset())

    def recall(self, memory: dict[str, npt.NDArray[Any]]) -> VecEnvObs:
        """As `DuffingVecEnv.recall`."""
        return self._see(self.venv.recall(memory))  # type: ignore[attr-defined]

    def step_async(self, actions: npt.NDArray[Any]) -> None:
        """Take what the network chose, as the foresight's actions."""
        choices = actions[:, 0] if self._levels is None else self._levels[actions]
        self.venv.step_async(self._view.act(choices))

    def step_wait(self) -> VecEnvStepReturn:
        """Step all rows."""
        seen = self._view.features
        before = seen[:, self.foresight.to_come]
        observations, rewards, dones, infos = self.venv.step_wait()
        ended = np.flatnonzero(dones)
        if len(ended):
            last = seen[ended]  # all the same, because nothing comes after it; its belief is gone
            if isinstance(self.foresight, Foresight):
                last = self.foresight.look([infos[row]["terminal_observation"] for row in ended]).features
            for row, features in zip(ended, last, strict=True):
                infos[row] |= {"terminal_observation": features, "TimeLimit.truncated": False}
        features = self._see(observations)
        to_come = np.where(dones, np.float32(0), features[:, self.foresight.to_come])
        return features, SCALE * (rewards + self._weight * (to_come - before)), dones, infos

    def _see(self, observations: Any) -> npt.NDArray[np.float32]:
        self._view = self.foresight.look(observations)
        return self._view.features


def foresight_of(
    envs: DuffingVectorEnv, env_id: str, options: dict[str, Any], seed: int
) -> Foresight | CommonForesight:
    """What a policy is trained with: the foresight of all oscillators; where the belief forgets, that of Eq. (2) alone.

    There a network with the other swings the oscillator up at once, and does not learn to wait.

    Args:
        envs: the environments.
        env_id: of their track.
        options: of theirs.
        seed: of the example that `Foresight` needs.
    """
    if not envs.experiment.setup.drifts:
        return CommonForesight(envs, own=True)
    return Foresight.of(envs, example_rate(env_id, options, seed))


def example_rate(env_id: str, options: dict[str, Any], seed: int) -> FloatArray:
    """(K, K) information about the coefficients that a sample brings on average, by a simple rule's example.

    The rule is that of foresight without a network: the push that brings most in four samples. It needs a rate itself,
    which a feedback law's example gives.

    Args:
        env_id: the track.
        options: of the environment.
        seed: of systems and noise.
    """
    envs = make(env_id, _EXAMPLES, options)
    law = make_policy("velocity-sign", envs, seed=seed)
    foresight = Foresight.of(envs, _rate(envs, lambda observations: law.predict(observations)[0], seed))

    def rule(observations: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
        view = foresight.look(observations)
        push = np.where(view.features[:, _BEST] >= 0, 1.0, -1.0)
        return view.act(push)

    rate = _rate(envs, rule, seed)
    envs.close()
    return rate


def _rate(envs: DuffingVectorEnv, act: Callable[[Any], Any], seed: int) -> FloatArray:
    """The mean information per sample of one episode in every environment, if noises were those of the prior."""
    observations, _ = envs.reset(seed=seed)
    before, usual = np.linalg.inv(envs.belief(0).coefficients_cov), _variance(envs.belief(0))
    rates, running = np.zeros((envs.num_envs, *before.shape)), np.ones(envs.num_envs, dtype=np.bool_)
    for t in range(envs.horizon):
        observations, _, terminated, truncated, infos = envs.step(act(observations))
        for row in np.flatnonzero(running & (terminated | truncated)):
            belief = infos["belief"][row]
            gained = np.linalg.inv(belief.coefficients_cov) - before
            rates[row] = gained * (_variance(belief) / usual) / (t + 1)
            running[row] = False
    mean: FloatArray = rates.mean(axis=0)
    return mean


def _variance(belief: Belief) -> float:
    """What is believed of the variance of an output about its prediction."""
    noises = belief.noises
    return float(noises[1] / noises[0] + noises[3] / noises[2])
