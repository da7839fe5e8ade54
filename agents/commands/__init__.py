"""The command ``duffing-env``: identify an oscillator, design and run experiments, train and evaluate policies.

Each command is a module here: a dataclass of its arguments, whose docstring is its help, with a method ``run`` that
imports slow modules. A new command needs an entry in `COMMANDS`.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from typing import Annotated, Any, Union

import tyro

from agents.cli import one_line_errors, parse_arguments
from agents.commands.design_command import DesignCommand
from agents.commands.evaluate_command import EvaluateCommand
from agents.commands.export_command import ExportCommand
from agents.commands.identify_command import IdentifyCommand
from agents.commands.report_command import ReportCommand
from agents.commands.rig_command import RigInitCommand, RigListCommand
from agents.commands.run_command import RunCommand

#: Stands before messages.
COMMAND_NAME = "duffing-env"


@dataclass(frozen=True)
class TrainPlaceholder:
    """Train a policy (PPO, SAC, TD3, TQC, recurrent PPO) on any track or rig."""


#: Name of a command to the class of its arguments; a group of commands has one name.
COMMANDS: dict[str, Any] = {
    "identify": IdentifyCommand,
    "design": DesignCommand,
    "run": RunCommand,
    "train": TrainPlaceholder,  # its arguments depend on the algorithm: `agents.commands.train_command`
    "evaluate": EvaluateCommand,
    "export": ExportCommand,
    "report": ReportCommand,
    "rig": Annotated[RigInitCommand, tyro.conf.subcommand("init")]
    | Annotated[RigListCommand, tyro.conf.subcommand("list")],
}

#: Help of the group of commands ``rig``.
_RIG_HELP = "Describe your rig in a file; list the rigs that ship."


def _all_subcommands() -> Any:
    """The commands, each with the first paragraph of its help, without the examples."""
    descriptions = {
        name: _RIG_HELP if name == "rig" else (command.__doc__ or "").split("\n\n")[0]
        for name, command in COMMANDS.items()
    }
    subcommands = (
        Annotated[command, tyro.conf.subcommand(name, description=descriptions[name])]
        for name, command in COMMANDS.items()
    )
    return Union[tuple(subcommands)]  # noqa: UP007


def main(arguments: list[str] | None = None) -> None:
    """Run a command.

    Args:
        arguments: of the command line; None: the arguments of this process.

    Raises:
        SystemExit: with status 2 for a bad value or file, 130 after Ctrl-C, 143 after SIGTERM, and 1 for a run that
            ended early.
    """
    arguments = sys.argv[1:] if arguments is None else arguments
    name, *rest = arguments or [""]
    if name == "train":
        from agents.commands.train_command import main as train

        return train(f"{COMMAND_NAME} train", rest)
    with one_line_errors(COMMAND_NAME):
        config = (tyro.conf.FlagCreatePairsOff,)
        if name in COMMANDS:
            description = _RIG_HELP if name == "rig" else None
            parse_arguments(
                COMMANDS[name], prog=f"{COMMAND_NAME} {name}", description=description, args=rest, config=config
            ).run()
        else:
            description = "Identify an oscillator; choose the most informative input. Each command has its own --help."
            parse_arguments(
                _all_subcommands(), prog=COMMAND_NAME, description=description, args=arguments, config=config
            )
