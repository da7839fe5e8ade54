"""``duffing-env train``: train a policy that chooses the input, resume it, or search for hyperparameters."""

import shlex
import sys
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Annotated

import tyro

from agents.cli import one_line_errors, parse_arguments
from agents.console_output import print_in_80_columns, print_warning
from agents.interruption import add_resume_hint
from agents.training import ALGORITHMS, TrainConfig, TrainingSubject, resume, train, train_seeds, tune_hyperparameters
from agents.training.environments.oscillator_family import FAMILY
from agents.training.run_folder import LEARNING_CURVE_FILE, UNTRAINED_FOLDER
from estimator.support.argument_checks import check_integer

TRAIN_HELP = """Train a policy that chooses the input, and compare it with the reference policies.

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

#: Hint after several trainings were stopped: --resume would finish one of them alone.
_REPEAT_COMMAND_HINT = "the same command goes on with what is left"

#: Fewest updates without a warning: after fewer a policy may be worse than an untrained one.
_MIN_UPDATES = 4


@dataclass(frozen=True)
class TrainCommand(TrainConfig):
    """Train a policy, and compare it."""

    resume: Path | None = None
    """Run folder to go on with after a stop; the run has its own settings, so no others are given here."""
    tune: int = 0
    """Trials of a search for hyperparameters, instead of a training; the same command goes on with a search."""
    seeds: int = 1
    """Trainings, of the seed and those after it, into OUTPUT/SEED each; the same command goes on with them."""
    ray: bool = False
    """Whether seeds, or trials of --tune, are spread over a Ray cluster: at RAY_ADDRESS, or of this machine."""
    systems: int = 32
    """Systems to compare on afterwards; 0 to skip the comparison."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_integer("tune", self.tune, 10**6, 0)
        check_integer("seeds", self.seeds, 1000)
        if self.seeds > 1 and self.tune:
            raise ValueError(f"seeds must be 1 in a search, but is {self.seeds}; leave it out, or tune")
        if self.ray and self.seeds == 1 and not self.tune:
            raise ValueError("ray spreads several trainings, but there is one; add --seeds or --tune, or leave it out")
        if self.systems != 0 and self.systems < 2:
            raise ValueError(f"systems must be 0 or at least 2, but is {self.systems}; intervals need more than one")

    def run(self) -> None:
        """Train or search, compare, and print where the files are."""
        each = self.hyperparameters.samples_per_update
        if self.resume is None and self.samples > self.steps:
            print_in_80_columns(
                f"An update takes {each:,} samples, so {self.samples:,} will be learned from, not {self.steps:,}."
            )
        if self.resume is None and (updates := self.samples // each) < _MIN_UPDATES:
            message = f"a training of {updates} update{'s' * (updates > 1)} may leave a policy worse than it began"
            print_warning(f"{message}; take more steps than {self.steps:,}")
        if self.tune:
            with add_resume_hint(lambda hint: _REPEAT_COMMAND_HINT):
                best = tune_hyperparameters(self, self.tune, on_ray=self.ray)
            print_in_80_columns(f"The best hyperparameters are in {best}")
            quoted_path = shlex.quote(str(best))
            print_in_80_columns(
                f"To train with them: the same command, with --settings {quoted_path} in place of --tune and --output"
            )
            return
        if self.seeds > 1:
            with add_resume_hint(lambda hint: _REPEAT_COMMAND_HINT):
                for folder in train_seeds(self, self.seeds, on_ray=self.ray):
                    print_in_80_columns(f"The run is in {folder}")
                    sys.stdout.flush()
            self._compare(f"{self.algo}={folder.parent}/[0-9]*", self, folder.parent)
            return
        if self.resume is None:
            run = train(self)
        else:
            if asdict(replace(self, resume=None, systems=TrainCommand.systems)) != asdict(TrainCommand()):
                raise ValueError("resume takes all settings but systems from the run; leave out the others")
            run = resume(self.resume)
        print_in_80_columns(f"Trained in {run.seconds:.0f} s, compilation included. The run is in {run.folder}")
        self._compare(str(run.folder), run.config, run.folder)
        if (picture := run.folder / LEARNING_CURVE_FILE).exists():
            print_in_80_columns(str(picture))
        else:
            print_in_80_columns("No episode ended, so there is no learning curve; take more steps.")

    def _compare(self, policy: str, config: TrainConfig, folder: Path) -> None:
        """Compare what was trained with the default policies of the track."""
        if config.env == FAMILY:
            module = "research.studies.unseen_oscillators"
            print_in_80_columns(f"From a checkout of the repository: python -m {module} --policies {policy}")
        elif self.systems:
            from agents.evaluation.comparison import compare_policies, default_policies

            untrained = folder / UNTRAINED_FOLDER
            untrained_policy = (str(untrained),) if untrained.exists() else ()
            policies = (*untrained_policy, policy, *default_policies(config.env, config.options))
            compare_policies(policies, config.env, self.systems, config.options, folder, headline_only=True)
            print("More, on more systems: duffing-env evaluate --help")


def default_train_command(arguments: list[str] | None) -> TrainCommand:
    """The defaults for the algorithm and the track in the arguments, with its hyperparameters under its name."""
    subject, _ = tyro.cli(TrainingSubject, args=arguments, add_help=False, return_unknown_args=True)
    settings_class, name = ALGORITHMS[subject.algo], tyro.conf.arg(name=subject.algo.replace("_", "-"))

    @dataclass(frozen=True)
    class Train(TrainCommand):
        """Train a policy, and compare it."""

        hyperparameters: Annotated[settings_class, name] = field(default=None)  # type: ignore[valid-type]
        """Hyperparameters of the algorithm; their defaults are those that the file has for the track."""

    return Train(**asdict(subject))


def main(program_name: str, arguments: list[str] | None = None) -> None:
    """Run the command.

    Args:
        program_name: stands before messages.
        arguments: of the command; None: the arguments of this process.

    Raises:
        SystemExit: as of `agents.commands.main`.
    """
    with one_line_errors(program_name):
        defaults = default_train_command(arguments)
        parse_arguments(
            type(defaults), prog=program_name, description=TRAIN_HELP, args=arguments, default=defaults
        ).run()
