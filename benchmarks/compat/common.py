"""What the rows share."""

from __future__ import annotations

ID = "duffing_env:duffing_env/Short-v0"
KEYS = {"information_gain", "log_posterior_gain", "diverged"}
ROWS = 4
CELLS = ("single", "vector", "train", "infos")


def made(autoreset_mode="SameStep"):
    """Ours, as a vector environment of Gymnasium."""
    import gymnasium as gym

    return gym.make_vec(ID, num_envs=ROWS, vectorization_mode="vector_entry_point", autoreset_mode=autoreset_mode)
