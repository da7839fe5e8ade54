"""``duffing-env rig``: write a rig file, or list the rigs that ship."""

from __future__ import annotations

import shlex
import textwrap
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro


@dataclass(frozen=True)
class RigInitCommand:
    """Write a rig file: by questions, from a record, or as a copy of a rig that ships.

    $ duffing-env rig init
    $ duffing-env rig init rig.toml --from data.csv
    $ duffing-env rig init rig.toml --from data.csv --step 1e-3
    $ duffing-env rig init rig.toml --from daten.csv --input Kraft --output Weg
    $ duffing-env rig init rig.toml --from beam
    """

    path: Annotated[Path, tyro.conf.Positional] = Path("rig.toml")
    """Output file."""
    source: Annotated[str | None, tyro.conf.arg(name="from", metavar="DATA|NAME")] = None
    """CSV or MAT file of a record, or the name of a rig that ships."""
    step: Annotated[float | None, tyro.conf.arg(metavar="SECONDS")] = None
    """Sampling step, for a record without a column of times, such as a MAT file."""
    input: Annotated[str | None, tyro.conf.arg(metavar="NAME")] = None
    """Column or variable of the input in a record, where it has none of the usual names."""
    output: Annotated[str | None, tyro.conf.arg(metavar="NAME")] = None
    """Column or variable of the output, likewise."""
    force: bool = False
    """Replace an existing file."""

    def run(self) -> None:
        """Write the file."""
        from agents.commands.rig_file_builder import ask_for_rig, rig_text_from_record
        from agents.console_output import print_in_80_columns
        from agents.output_paths import check_not_overwritten
        from estimator.rigs.rig import SHIPPED_RIGS
        from estimator.support.file_io import write_atomically

        check_not_overwritten("path of the rig file", self.path, self.force)
        for name in ("step", "input", "output"):
            if getattr(self, name) is not None and (self.source is None or self.source in SHIPPED_RIGS):
                raise ValueError(f"{name} goes with a record; add --from data.csv, or leave it out")
        summary = ""
        if self.source is None:
            text = ask_for_rig().to_toml()
        elif self.source in SHIPPED_RIGS:
            text = SHIPPED_RIGS[self.source].read_text(encoding="utf-8")
        else:
            text, summary = rig_text_from_record(Path(self.source), self.step, self.input, self.output)
        write_atomically(self.path, text)
        if summary:
            print_in_80_columns(summary)
        print_in_80_columns(f"Wrote {self.path}: read it, and correct what is wrong.")
        data = "data.csv" if self.source is None or self.source in SHIPPED_RIGS else self.source
        print_in_80_columns(f"Next: {shlex.join(['duffing-env', 'identify', str(self.path), str(data)])}")


@dataclass(frozen=True)
class RigListCommand:
    """List the rigs that ship; each name stands for its file.

    $ duffing-env rig list
    """

    def run(self) -> None:
        """Print the list."""
        from estimator.rigs.rig import SHIPPED_RIGS

        width = max(map(len, SHIPPED_RIGS))
        for name, path in SHIPPED_RIGS.items():
            first = path.read_text(encoding="utf-8").splitlines()[0].lstrip("# ")
            description = first.split(". See")[0].rstrip(".")
            print(
                textwrap.fill(description, 80, initial_indent=f"{name:<{width}}  ", subsequent_indent=" " * (width + 2))
            )
