"""The systems of a track, as a batch."""

from __future__ import annotations

from typing import Any

import gymnasium as gym

from agents.loading import check_options
from duffing_env.vector_env import DuffingVectorEnv

#: Options of the systems that policies are compared on.
TESTED = {"branch": "test"}


def make(env_id: str, systems: int, options: dict[str, Any] | None = None) -> DuffingVectorEnv:
    """A batch of a track.

    Raises:
        ValueError: for an option that the track does not have, or that is none.
    """
    check_options(options or {})
    envs = gym.make_vec(env_id, num_envs=systems, vectorization_mode="vector_entry_point", **(options or {}))
    assert isinstance(envs, DuffingVectorEnv)
    return envs
