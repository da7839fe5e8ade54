"""Trains Stable-Baselines3's algorithms with their default hyperparameters on one environment of a track.

$ python -m research.studies.sb3_baselines --algo ppo --seed 0
$ duffing-env evaluate --protocol Short-v0 --policies "mine=runs/sb3-ppo-short-v0-*" --submit mine

A run on one core takes minutes with PPO, and hours with SAC and TQC, which take a gradient step with every sample.
"""

from __future__ import annotations

import sys
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal

from agents.cli import run_script
from agents.track_ids import check_is_duffing_track, full_track_id
from estimator.support.optional_dependencies import require_packages


@dataclass(frozen=True)
class Config:
    """Train one of Stable-Baselines3's algorithms with its defaults."""

    algo: Literal["ppo", "sac", "tqc"] = "ppo"
    """Algorithm."""
    env: str = "duffing_env/Short-v0"
    """Track, such as Short-v0."""
    steps: int = 1_000_000
    """Samples to learn from; the last roll-out of PPO is finished."""
    seed: int = 0
    """Seed of everything."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "env", full_track_id(self.env))
        check_is_duffing_track(self.env)

    @property
    def folder(self) -> Path:
        """The folder of the policy."""
        return Path("runs") / f"sb3-{self.algo}-{self.env.split('/')[-1].lower()}-{self.seed}"


def main(config: Config) -> None:
    """Train, and write the policy folder."""
    require_packages("torch", "stable_baselines3", "sb3_contrib")
    import gymnasium as gym
    import torch
    from sb3_contrib import TQC
    from stable_baselines3 import PPO, SAC

    from agents.policies.networks.policy_saving import check_policy_folder, save_policy
    from agents.result_files import package_versions

    check_policy_folder("folder", config.folder)
    torch.set_num_threads(1)
    algorithm = {"ppo": PPO, "sac": SAC, "tqc": TQC}[config.algo]
    model = algorithm("MlpPolicy", gym.make(config.env), seed=config.seed, device="cpu").learn(config.steps)
    card = {
        "algorithm": config.algo,
        "steps": model.num_timesteps,
        "config": asdict(config),
        "command": [Path(sys.argv[0]).name, *sys.argv[1:]],
        "versions": package_versions("stable-baselines3", "sb3-contrib", "torch"),
    }
    save_policy(config.folder, model, card)
    print(config.folder)


if __name__ == "__main__":
    run_script(main, Config, __doc__)
