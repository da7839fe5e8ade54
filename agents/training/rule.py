"""Where a network with the features of all oscillators begins: at the rule of `lookahead`, not at chance."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import gymnasium as gym

from agents.policies.foresight import CommonForesight
from agents.policies.lookahead import NONE, UP

if TYPE_CHECKING:
    from stable_baselines3.common.base_class import BaseAlgorithm

#: How sharply a layer tells the sign of what it is given.
_SHARP = 3.0


def begin_with_rule(model: BaseAlgorithm, envs: Any, logit: float) -> None:
    """Let a new model's actor choose as `lookahead` does: two units of every layer carry what that depends on.

    A model that does not choose from levels, or does not see the features of all oscillators, is left as it is.

    Args:
        model: of Stable-Baselines3.
        envs: as it sees them.
        logit: of what brings most; the smaller, the more is explored.
    """
    import torch

    if not isinstance(getattr(envs, "foresight", None), CommonForesight):
        return
    if not isinstance(envs.action_space, gym.spaces.Discrete):
        return
    policy: Any = model.policy
    layers = [layer for layer in policy.mlp_extractor.policy_net if isinstance(layer, torch.nn.Linear)]
    with torch.no_grad():
        inputs = UP, NONE
        for layer in layers:
            layer.weight[:2], layer.bias[:2] = 0.0, 0.0
            for unit in range(2):
                layer.weight[unit, inputs[unit]] = _SHARP
            inputs = 0, 1
        last = policy.action_net.weight
        last[:, :2] = 0.0
        last[-1, 0], last[0, 0] = logit, -logit
        if len(last) % 2:
            last[len(last) // 2, 1] = 2.0 * logit
