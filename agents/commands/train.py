"""``duffing-env train``: a policy that chooses the input."""

import shlex
import sys
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Annotated

import tyro

from agents.cli import parsed, told_in_one_line
from agents.results import say, warn
from agents.stopping import telling
from agents.training import ALGORITHMS, Subject, TrainConfig, resume, train, train_seeds, tune
from agents.training.family import FAMILY
from agents.training.runs import LEARNING, UNTRAINED
from estimator.checks import whole

DESCRIPTION = """Train a policy that chooses the input, and compare it with the reference policies.

$ duffing-env train                                    PPO on Amplitude-v0
$ duffing-env train --steps 1000000 --seed 3           shorter, another seed
$ duffing-env train --reward log_posterior             another reward
$ duffing-env train --rig rig.toml                     on a rig of your own
$ duffing-env train --env family                       to play any oscillator
$ duffing-env train --imitate efe                      from another policy
$ duffing-env train --algo sac --help                  another algorithm
$ duffing-env train --algo td3 --tune 50               search hyperparameters
$ duffing-env train --seeds 5 --ray                    five seeds, on a cluster
$ duffing-env train --resume runs/ppo-amplitude-v0-0   go on after a stop
"""

#: How several trainings go on: each of them alone would be finished without the others.
_THE_SAME = "the same command goes on with what is left"

#: Updates that teach too little to make up for what exploring unlearns.
_FEW = 4


@dataclass(frozen=True)
class Config(TrainConfig):
    """Train a policy, and compare it."""

    resume: Path | None = None
    """Run folder to go on with after it was stopped; it has its settings in it, so none are taken here."""
    tune: int = 0
    """Trials of a search for hyperparameters, instead of a training; the same command goes on with a search."""
    seeds: int = 1
    """Trainings, of the seed and those after it, into OUTPUT/SEED each; the same command goes on with them."""
    ray: bool = False
    """Whether seeds, or trials of --tune, are spread over a Ray cluster: that of RAY_ADDRESS, or of this machine."""
    systems: int = 32
    """Systems to compare on afterwards; 0 to skip the comparison."""

    def __post_init__(self) -> None:
        super().__post_init__()
        whole("tune", self.tune, 10**6, 0)
        whole("seeds", self.seeds, 1000)
        if self.seeds > 1 and self.tune:
            raise ValueError(f"seeds must be 1 in a search, but is {self.seeds}; leave it out, or tune")
        if self.ray and self.seeds == 1 and not self.tune:
            raise ValueError("ray spreads several trainings, but there is one; add --seeds or --tune, or leave it out")
        if self.systems != 0 and self.systems < 2:
            raise ValueError(f"systems must be 0 or at least 2, but is {self.systems}; intervals need more than one")

    def run(self) -> None:
        """Train, compare, and say where everything is."""
        each = self.hyperparameters.samples_per_update
        if self.resume is None and self.samples > self.steps:
            say(f"An update takes {each:,} samples, so {self.samples:,} will be learned from, not {self.steps:,}.")
        if self.resume is None and (updates := self.samples // each) < _FEW:
            said = f"a training of {updates} update{'s' * (updates > 1)} may leave a policy worse than it began"
            warn(f"{said}; take more steps than {self.steps:,}")
        if self.tune:
            with telling(lambda said: _THE_SAME):
                best = tune(self, self.tune, on_ray=self.ray)
            say(f"The best hyperparameters are in {best}")
            given = shlex.quote(str(best))
            say(f"To train with them: the same command, with --settings {given} in place of --tune and --output")
            return
        if self.seeds > 1:
            with telling(lambda said: _THE_SAME):
                for folder in train_seeds(self, self.seeds, on_ray=self.ray):
                    say(f"The run is in {folder}")
                    sys.stdout.flush()
            self._compare(f"{self.algo}={folder.parent}/[0-9]*", self, folder.parent)
            return
        if self.resume is None:
            run = train(self)
        else:
            if asdict(replace(self, resume=None, systems=Config.systems)) != asdict(Config()):
                raise ValueError("resume takes all settings but systems from the run; leave out the others")
            run = resume(self.resume)
        say(f"Trained in {run.seconds:.0f} s, compilation included. The run is in {run.folder}")
        self._compare(str(run.folder), run.config, run.folder)
        if (picture := run.folder / LEARNING).exists():
            say(str(picture))
        else:
            say("No episode ended, so there is no learning curve; take more steps.")

    def _compare(self, policy: str, config: TrainConfig, folder: Path) -> None:
        """Compare what was trained with the usual policies."""
        if config.env == FAMILY:
            say(f"python -m agents.studies.family --policies {policy}")
        elif self.systems:
            from agents.evaluation.comparison import compare, usual_policies

            untrained = folder / UNTRAINED
            begun = (str(untrained),) if untrained.exists() else ()
            policies = (*begun, policy, *usual_policies(config.env, config.options))
            compare(policies, config.env, self.systems, config.options, folder, briefly=True)
            print("More, on more systems: duffing-env evaluate --help")


def default_config(words: list[str] | None) -> Config:
    """The defaults of the algorithm and the track that the words name, its hyperparameters under its name."""
    subject, _ = tyro.cli(Subject, args=words, add_help=False, return_unknown_args=True)
    kind, name = ALGORITHMS[subject.algo], tyro.conf.arg(name=subject.algo.replace("_", "-"))

    @dataclass(frozen=True)
    class Train(Config):
        """Train a policy, and compare it."""

        hyperparameters: Annotated[kind, name] = field(default=None)  # type: ignore[valid-type]
        """Hyperparameters of the algorithm; their defaults are those that the file has for the track."""

    return Train(**asdict(subject))


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
        parsed(type(start), prog=name, description=DESCRIPTION, args=words, default=start).run()
