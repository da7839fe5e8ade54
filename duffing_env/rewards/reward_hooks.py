"""Reward hooks: compiled functions of a reward that the kernel calls at fixed points of a step."""

from __future__ import annotations

from typing import Any, NamedTuple

from estimator.compilation.simd import jit


class RewardHooks(NamedTuple):
    """The compiled functions that compute a reward's term and leave it in row ``HOOK_REWARD``.

    Attributes:
        on_episode_start: ``on_episode_start(W, j, params)`` where an episode begins in lane j, or its truth changes.
        before_plant_step: ``before_plant_step(W, params)`` before the plant moves.
        before_update: ``before_update(W, params)`` before the belief update.
        after_update: ``after_update(W, params)`` after the belief update.
    """

    on_episode_start: Any
    before_plant_step: Any
    before_update: Any
    after_update: Any


@jit
def no_hook(W, params):
    """A hook that does nothing."""


@jit
def no_lane_hook(W, j, params):
    """A hook of one lane that does nothing."""


#: The hooks of a reward that is a weighted sum alone.
NO_HOOKS = RewardHooks(no_lane_hook, no_hook, no_hook, no_hook)
