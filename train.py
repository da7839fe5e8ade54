"""Train a policy that chooses the input, and compare it with the reference policies.

$ python train.py                                  PPO on Amplitude-v0, into runs/
$ python train.py --steps 1000000 --seed 3         shorter, another seed
$ python train.py --reward log_posterior           another reward
$ python train.py --rig rig.toml                   on a rig of your own
$ python train.py --env family                     on oscillators of all kinds, to play any
$ python train.py --algo sac --help                another algorithm, and its hyperparameters
$ python train.py --algo td3 --tune 50             search for its hyperparameters
$ python train.py --resume runs/ppo-amplitude-v0-0 go on with a run that was stopped
"""

from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Annotated

import tyro

from agents.cli import run_script
from agents.training import ALGORITHMS, Subject, TrainConfig, resume, train, tune
from agents.training.family import FAMILY


@dataclass(frozen=True)
class Config(TrainConfig):
    """Train a policy, and compare it."""

    resume: Path | None = None
    """Run folder to go on with after it was stopped; it has its settings in it, so none are taken here."""
    tune: int = 0
    """Trials of a search for hyperparameters, instead of a training; the same command goes on with a search."""
    systems: int = 256
    """Systems to compare on afterwards; 0 to skip the comparison."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.tune < 0:
            raise ValueError(f"tune must be at least 0, but is {self.tune}")
        if self.systems != 0 and self.systems < 2:
            raise ValueError(f"systems must be 0 or at least 2, but is {self.systems}; intervals need more than one")


def main(config: Config) -> None:
    """Train, compare, and say where everything is."""
    from agents.evaluation.comparison import compare, usual_policies

    if config.tune:
        best = tune(config, config.tune)
        print(f"The best hyperparameters are in {best}: python train.py --algo {config.algo} --settings {best}")
        return
    if config.resume is None:
        run = train(config)
    else:
        if asdict(replace(config, resume=None, systems=256)) != asdict(Config()):
            raise ValueError("resume takes all settings but systems from the run; leave out the others")
        run = resume(config.resume)
    print(f"Trained in {run.seconds:.0f} s, compilation included. The run is in {run.folder}")
    if config.env == FAMILY:
        print(f"python -m agents.studies.universal --policies {run.folder}")
    elif config.systems:
        policies = (str(run.folder), *usual_policies(run.config.env, run.config.options))
        compare(policies, run.config.env, config.systems, run.config.options, run.folder)
    print(run.folder / "learning_curve.png")


def default_config() -> Config:
    """The defaults of the algorithm and the track that the command line names, its hyperparameters under its name."""
    subject, _ = tyro.cli(Subject, add_help=False, return_unknown_args=True)
    kind = ALGORITHMS[subject.algo]

    @dataclass(frozen=True)
    class AlgorithmConfig(Config):
        """Train a policy, and compare it."""

        hyperparameters: Annotated[kind, tyro.conf.arg(name=subject.algo.replace("_", "-"))] = field(default=None)
        """Hyperparameters of the algorithm; their defaults are those that the file has for the track."""

    return AlgorithmConfig(**asdict(subject))


if __name__ == "__main__":
    run_script(main, Config, __doc__, default_config)
