"""Where a network with the features of all oscillators begins: at the rule that these tell, not at chance."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np
import numpy.typing as npt

from agents.policies.foresight import CommonForesight
from agents.policies.imagined import FEATURES

if TYPE_CHECKING:
    from stable_baselines3.common.base_class import BaseAlgorithm

#: Moves that the rule looks ahead.
_AHEAD = 8
_UP, _NONE = (FEATURES.index(f"best_{way}_{_AHEAD}") for way in ("up", "none"))

#: Samples of every environment that are imitated, the share of them that is played at random, passes over them, and the
#: probability that is left to other choices, so that there is something to try.
_SAMPLES, _RANDOM, _PASSES, _LEFT = 128, 0.1, 4, 0.1


def rule(features: npt.NDArray[np.float32], levels: int) -> npt.NDArray[np.int64]:
    """The choices (n,) of what brings most in `_AHEAD` moves, by features (n, len(FEATURES)): up, none, or down.

    Example:
        >>> import numpy as np
        >>> seen = np.zeros((3, len(FEATURES)), dtype=np.float32)
        >>> seen[:, _UP], seen[:, _NONE] = [1.0, -1.0, 1.0], [-1.0, -1.0, 0.5]
        >>> rule(seen, 5)
        array([4, 0, 2])
    """
    push = np.where(features[:, _UP] >= 0.0, levels - 1, 0)
    return np.where(features[:, _NONE] > 0.0, levels // 2, push) if levels % 2 else push


def begin_with_rule(model: BaseAlgorithm, envs: Any, seed: int) -> None:
    """Train a new model's actor to choose as `rule` does, from what it sees while that is played.

    A model that does not choose from levels, or does not see the features of all oscillators, is left as it is.

    Args:
        model: of Stable-Baselines3.
        envs: as it sees them.
        seed: of the choices at random, and of the order.
    """
    import torch

    if not isinstance(getattr(envs, "foresight", None), CommonForesight):
        return
    if not isinstance(envs.action_space, gym.spaces.Discrete):
        return
    levels = int(envs.action_space.n)
    rng = np.random.default_rng(seed)
    seen, chosen = [], []
    features = envs.reset()
    for _ in range(_SAMPLES):
        best = rule(features, levels)
        seen.append(features)
        chosen.append(best)
        tried = rng.integers(levels, size=len(best))
        features, *_ = envs.step(np.where(rng.random(len(best)) < _RANDOM, tried, best))
    inputs, targets = torch.from_numpy(np.concatenate(seen)), torch.from_numpy(np.concatenate(chosen))
    policy: Any = model.policy
    optimizer = torch.optim.Adam(policy.parameters(), lr=1e-3)
    for _ in range(_PASSES):
        for batch in torch.from_numpy(rng.permutation(len(inputs))).split(2048):
            logits = policy.get_distribution(inputs[batch]).distribution.logits
            loss = torch.nn.functional.cross_entropy(logits, targets[batch], label_smoothing=_LEFT)
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
