"""Train a policy that chooses the input, and compare it with the reference policies.

python train.py                                  PPO on Amplitude-v0, into runs/
python train.py --steps 1000000 --seed 3         shorter, another seed
python train.py --reward log_posterior           another reward
"""

from __future__ import annotations

from dataclasses import dataclass

from agents.cli import run_script
from agents.training import TrainConfig, train


@dataclass(frozen=True)
class Config(TrainConfig):
    """Train a policy, and compare it."""

    systems: int = 256
    """Systems to compare on afterwards; 0 to skip the comparison."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.systems != 0 and self.systems < 2:
            raise ValueError(f"systems must be 0 or at least 2, but is {self.systems}; intervals need more than one")


def main(config: Config) -> None:
    """Train, compare, and say where everything is."""
    from agents.leaderboard import BASELINES, compare

    run = train(config)
    print(f"Trained in {run.seconds:.0f} s, compilation included. The run is in {run.folder}")
    if config.systems:
        policies = (str(run.folder), *BASELINES)
        compare(policies, config.env, config.systems, config.options, run.folder)
    print(run.folder / "learning_curve.png")


if __name__ == "__main__":
    run_script(main, Config, __doc__)
