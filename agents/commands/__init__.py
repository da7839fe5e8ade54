"""``duffing-env``: the command for a user's own oscillator.

Each command is a module here: a dataclass of what it takes, whose docstring is its help, with a method ``run`` that
imports what is heavy. To add one, put it into `COMMANDS`.
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

COMMAND_NAME = "duffing-env"


@dataclass(frozen=True)
class TrainPlaceholder:
    """Train a policy (PPO, SAC, TD3, TQC, recurrent PPO) on any track or rig."""


#: What each command takes, by its name; commands of a group are under one.
COMMANDS: dict[str, Any] = {
    "identify": IdentifyCommand,
    "design": DesignCommand,
    "run": RunCommand,
    "train": TrainPlaceholder,  # its settings follow from the algorithm: `agents.commands.train_command`
    "evaluate": EvaluateCommand,
    "export": ExportCommand,
    "report": ReportCommand,
    "rig": Annotated[RigInitCommand, tyro.conf.subcommand("init")]
    | Annotated[RigListCommand, tyro.conf.subcommand("list")],
}

_RIG_HELP = "Describe your rig in a file; list the rigs that ship."


def _all_subcommands() -> Any:
    """The commands, each with the first paragraph of its help: examples would be broken into several lines here."""
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
        arguments: of the command line; those of this process where they are None.

    Raises:
        SystemExit: with status 2 where a value or a file is bad, 130 after Ctrl-C, 143 after SIGTERM, and 1 where a run
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
            description = "Identify an oscillator; choose the input that tells most. Each command has its own --help."
            parse_arguments(
                _all_subcommands(), prog=COMMAND_NAME, description=description, args=arguments, config=config
            )
