"""The actor of a Stable-Baselines3 actor-critic, as imitation and ascent train it: its mean, and roll-outs of it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm

from duffing_env.layout import OBSERVATION

FloatArray = npt.NDArray[np.float32]

# Places in the observation: those that turn over with input and displacement, and the time.
_ODD = [list(OBSERVATION).index(name) for name in ("state_x0", "state_x1", "last_input", "last_output")]
_TIME_LEFT = list(OBSERVATION).index("time_left")

#: Entries of the observation that hardly move are scaled as if they moved by this much.
_LEAST_STD = 0.05


class Actor:
    """The mean action as a function of the observation, and its parameters.

    Args:
        model: PPO, or another one with an actor-critic of separate networks; its actor is what is trained.
    """

    def __init__(self, model: OnPolicyAlgorithm) -> None:
        policy: Any = model.policy
        levels = int(getattr(policy.action_space, "n", 0))
        self._levels = torch.linspace(-1.0, 1.0, levels) if levels else None
        self._network = torch.nn.Sequential(*policy.mlp_extractor.policy_net, policy.action_net)
        self.parameters = list(self._network.parameters())

    def __call__(self, observations: torch.Tensor) -> torch.Tensor:
        """Means (n,) of the action, not clipped, for observations (n, features)."""
        outputs: torch.Tensor = self._network(observations)
        return outputs[:, 0] if self._levels is None else outputs.softmax(dim=1) @ self._levels

    def act(self, observations: FloatArray) -> FloatArray:
        """The means, or the likeliest of some levels, in NumPy and without a gradient."""
        with torch.no_grad():
            outputs = self._network(torch.from_numpy(observations))
            actions = outputs[:, 0] if self._levels is None else self._levels[outputs.argmax(dim=1)]
        found: FloatArray = actions.numpy()
        return found

    @contextmanager
    def standardised(self, observations: FloatArray) -> Iterator[Standard]:
        """Within, the first layer expects standardised observations, which train much faster; the function stays.

        Args:
            observations: (n, features) whose means and standard deviations are the standard.
        """
        standard = Standard(observations.mean(axis=0), np.maximum(observations.std(axis=0), _LEAST_STD))
        mean, std = torch.from_numpy(standard.mean), torch.from_numpy(standard.std)
        weight, bias = self.parameters[:2]
        with torch.no_grad():
            bias.add_(weight @ mean)
            weight.mul_(std)
        yield standard
        with torch.no_grad():
            weight.div_(std)
            bias.sub_(weight @ mean)


class Standard:
    """Means and standard deviations (features,) of observations."""

    def __init__(self, mean: FloatArray, std: FloatArray) -> None:
        self.mean, self.std = mean, std

    def __call__(self, observations: FloatArray) -> FloatArray:
        """Observations in standard deviations from the mean."""
        standard: FloatArray = (observations - self.mean) / self.std
        return standard


def at_rest(observations: FloatArray) -> npt.NDArray[np.bool_]:
    """(n,) which observations (n, features) begin an episode, where the oscillator rests."""
    return observations[:, _TIME_LEFT] == 1.0


def turned(observations: FloatArray, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
    """Observations (n, features), half of those that are in motion turned over; and the sign (n,) of each."""
    over = (rng.random(len(observations)) < 0.5) & ~at_rest(observations)
    signs = np.where(over, -1.0, 1.0).astype(np.float32)
    observations = observations.copy()
    observations[:, _ODD] *= signs[:, None]
    return observations, signs
