"""Train a policy that chooses the input, and compare it with the reference policies.

python train.py                                  PPO on Amplitude-v0, into runs/
python train.py --steps 1000000 --seed 3         shorter, another seed
python train.py --reward log_posterior           another reward
"""

from __future__ import annotations

import sys
from dataclasses import dataclass

import tyro

from agents.training import TrainConfig, train


@dataclass(frozen=True)
class Config(TrainConfig):
    """Train a policy that chooses the input, and compare it with the reference policies."""

    systems: int = 256
    """Systems to compare on afterwards; 0 to skip the comparison."""


def main(config: Config) -> None:
    """Train, compare, and say where everything is."""
    from agents.comparison import compare

    run = train(config)
    print(f"trained in {run.seconds:.0f} s; the run is in {run.folder}")
    if config.systems:
        compare([str(run.folder)], config.env, config.systems, config.env_options, run.folder)


if __name__ == "__main__":
    try:
        main(tyro.cli(Config, description=__doc__))
    except ValueError as error:
        sys.exit(f"train.py: {error}")
