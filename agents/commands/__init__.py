"""``duffing-env``: the command for a user's own oscillator.

Each command is a module here: a dataclass of what it takes, whose docstring is its help, with a method ``run`` that
imports what is heavy. To add one, put it into `Command`.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from typing import Annotated, Any

import tyro

from agents.cli import told_in_one_line
from agents.commands.design import Design
from agents.commands.evaluate import Evaluate
from agents.commands.export import Export
from agents.commands.identify import Identify
from agents.commands.report import Report
from agents.commands.rig import Init, List
from agents.commands.run import Run

NAME = "duffing-env"

_subcommand = tyro.conf.subcommand


@dataclass(frozen=True)
class Train:
    """Train a policy (PPO, SAC, TD3, TQC, recurrent PPO) on any track or rig."""


#: What the command line chooses from: a name for each command, and commands of a group under one name.
Command = (
    Annotated[Identify, _subcommand("identify")]
    | Annotated[Design, _subcommand("design")]
    | Annotated[Run, _subcommand("run")]
    | Annotated[Train, _subcommand("train")]  # its settings follow from the algorithm: `agents.commands.train`
    | Annotated[Evaluate, _subcommand("evaluate")]
    | Annotated[Export, _subcommand("export")]
    | Annotated[Report, _subcommand("report")]
    | Annotated[
        Annotated[Init, _subcommand("init")] | Annotated[List, _subcommand("list")],
        _subcommand("rig", description="Describe your rig in a file; list the rigs that ship."),
    ]
)


def main(words: list[str] | None = None) -> None:
    """Run a command.

    Args:
        words: of the command line; those of this process where they are None.

    Raises:
        SystemExit: with status 2 where a value or a file is bad, and 130 after Ctrl-C.
    """
    words = sys.argv[1:] if words is None else words
    if words[:1] == ["train"]:
        from agents.commands.train import main as train

        return train(f"{NAME} train", words[1:])
    with told_in_one_line(NAME):
        command: Any = tyro.cli(
            Command,
            prog=NAME,
            description="Identify an oscillator; choose the input that tells most. Each command has its own --help.",
            args=words,
            config=(tyro.conf.FlagCreatePairsOff,),
        )
        command.run()
