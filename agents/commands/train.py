"""``duffing-env train``: a policy that chooses the input."""

from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Annotated

import tyro

from agents.cli import told_in_one_line
from agents.training import ALGORITHMS, Subject, TrainConfig, resume, train, tune
from agents.training.family import FAMILY

DESCRIPTION = """Train a policy that chooses the input, and compare it with the reference policies.

$ duffing-env train                                    PPO on Amplitude-v0
$ duffing-env train --steps 1000000 --seed 3           shorter, another seed
$ duffing-env train --reward log_posterior             another reward
$ duffing-env train --rig rig.toml                     on a rig of your own
$ duffing-env train --env family                       to play any oscillator
$ duffing-env train --algo sac --help                  another algorithm
$ duffing-env train --algo td3 --tune 50               search hyperparameters
$ duffing-env train --resume runs/ppo-amplitude-v0-0   go on after a stop
"""


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

    def run(self) -> None:
        """Train, compare, and say where everything is."""
        from agents.evaluation.comparison import compare, usual_policies

        if self.resume is None and self.samples > self.steps:
            each = self.hyperparameters.samples_per_update
            print(f"An update takes {each:,} samples, so {self.samples:,} will be learned from, not {self.steps:,}.")
        if self.tune:
            best = tune(self, self.tune)
            print(f"The best hyperparameters are in {best}: duffing-env train --algo {self.algo} --settings {best}")
            return
        if self.resume is None:
            run = train(self)
        else:
            if asdict(replace(self, resume=None, systems=256)) != asdict(Config()):
                raise ValueError("resume takes all settings but systems from the run; leave out the others")
            run = resume(self.resume)
        print(f"Trained in {run.seconds:.0f} s, compilation included. The run is in {run.folder}")
        if self.env == FAMILY:
            print(f"python -m agents.studies.universal --policies {run.folder}")
        elif self.systems:
            policies = (str(run.folder), *usual_policies(run.config.env, run.config.options))
            compare(policies, run.config.env, self.systems, run.config.options, run.folder)
        print(run.folder / "learning_curve.png")


def default_config(words: list[str] | None) -> Config:
    """The defaults of the algorithm and the track that the words name, its hyperparameters under its name."""
    subject, _ = tyro.cli(Subject, args=words, add_help=False, return_unknown_args=True)
    kind, name = ALGORITHMS[subject.algo], tyro.conf.arg(name=subject.algo.replace("_", "-"))

    @dataclass(frozen=True)
    class AlgorithmConfig(Config):
        """Train a policy, and compare it."""

        hyperparameters: Annotated[kind, name] = field(default=None)  # type: ignore[valid-type]
        """Hyperparameters of the algorithm; their defaults are those that the file has for the track."""

    return AlgorithmConfig(**asdict(subject))


def main(name: str, words: list[str] | None = None) -> None:
    """Run the command.

    Args:
        name: that it is called by.
        words: its arguments; those of this process where they are None.

    Raises:
        SystemExit: as `agents.commands.main`.
    """
    with told_in_one_line(name):
        start = default_config(words)
        tyro.cli(type(start), prog=name, description=DESCRIPTION, args=words, default=start).run()
