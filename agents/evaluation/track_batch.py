"""The systems of a track, as a batch."""

from __future__ import annotations

from typing import Any

import gymnasium as gym

from agents.user_code import check_env_options
from duffing_env.vector_env import DuffingVectorEnv

#: Options of the systems that policies are compared on.
TEST_OPTIONS = {"branch": "test"}


def make_track_batch(env_id: str, n_systems: int, options: dict[str, Any] | None = None) -> DuffingVectorEnv:
    """A batch of a track.

    Raises:
        ValueError: for an option that the track does not have, or that is none.
    """
    check_env_options(options or {})
    envs = gym.make_vec(env_id, num_envs=n_systems, vectorization_mode="vector_entry_point", **(options or {}))
    assert isinstance(envs, DuffingVectorEnv)
    return envs
