"""``duffing-env rig``: describe a rig in a file."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro


@dataclass(frozen=True)
class Init:
    """Write a rig file: ask, or take what a record tells.

    $ duffing-env rig init
    $ duffing-env rig init rig.toml --from data.csv
    """

    path: Annotated[Path, tyro.conf.Positional] = Path("rig.toml")
    """The file that is written."""
    source: Annotated[str | None, tyro.conf.arg(name="from", metavar="SOURCE")] = None
    """CSV file of a record."""
    force: bool = False
    """Replace the file where there is one."""

    def run(self) -> None:
        """Ask, and write."""
        raise ValueError("not yet")


@dataclass(frozen=True)
class List:
    """List the rigs that ship."""

    def run(self) -> None:
        """Print them."""


RigCommand = Annotated[Init, tyro.conf.subcommand("init")] | Annotated[List, tyro.conf.subcommand("list")]
