"""``duffing-env``: the command for a user's own oscillator.

Each command is a module here: a dataclass of what it takes, whose docstring is its help, with a method ``run`` that
imports what is heavy. To add one, put it into `COMMANDS`.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from typing import Annotated, Any, Union

import tyro

from agents.cli import parsed, told_in_one_line
from agents.commands.design import Design
from agents.commands.evaluate import Evaluate
from agents.commands.export import Export
from agents.commands.identify import Identify
from agents.commands.report import Report
from agents.commands.rig import Init, List
from agents.commands.run import Run

NAME = "duffing-env"


@dataclass(frozen=True)
class Train:
    """Train a policy (PPO, SAC, TD3, TQC, recurrent PPO) on any track or rig."""


#: What each command takes, by its name; commands of a group are under one.
COMMANDS: dict[str, Any] = {
    "identify": Identify,
    "design": Design,
    "run": Run,
    "train": Train,  # its settings follow from the algorithm: `agents.commands.train`
    "evaluate": Evaluate,
    "export": Export,
    "report": Report,
    "rig": Annotated[Init, tyro.conf.subcommand("init")] | Annotated[List, tyro.conf.subcommand("list")],
}

_RIG = "Describe your rig in a file; list the rigs that ship."


def _listed() -> Any:
    """The commands, each with the first paragraph of its help: examples would be broken into several lines here."""
    said = {name: _RIG if name == "rig" else (kind.__doc__ or "").split("\n\n")[0] for name, kind in COMMANDS.items()}
    kinds = (Annotated[kind, tyro.conf.subcommand(name, description=said[name])] for name, kind in COMMANDS.items())
    return Union[tuple(kinds)]  # noqa: UP007


def main(words: list[str] | None = None) -> None:
    """Run a command.

    Args:
        words: of the command line; those of this process where they are None.

    Raises:
        SystemExit: with status 2 where a value or a file is bad, 130 after Ctrl-C, 143 after SIGTERM, and 1 where a run
            ended early.
    """
    words = sys.argv[1:] if words is None else words
    name, *rest = words or [""]
    if name == "train":
        from agents.commands.train import main as train

        return train(f"{NAME} train", rest)
    with told_in_one_line(NAME):
        config = (tyro.conf.FlagCreatePairsOff,)
        if name in COMMANDS:
            about = _RIG if name == "rig" else None
            parsed(COMMANDS[name], prog=f"{NAME} {name}", description=about, args=rest, config=config).run()
        else:
            about = "Identify an oscillator; choose the input that tells most. Each command has its own --help."
            parsed(_listed(), prog=NAME, description=about, args=words, config=config)
