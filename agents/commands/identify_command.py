"""``duffing-env identify``: parameters of an oscillator with credible intervals, from records."""

from __future__ import annotations

import json
import shlex
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

if TYPE_CHECKING:
    from estimator import Result


@dataclass(frozen=True)
class IdentifyCommand:
    """Identify m, c, a and b from records, with intervals, and warn where the intervals do not hold.

    $ duffing-env identify rig.toml data.csv
    $ duffing-env identify rig.toml monday.csv tuesday.csv --report out.html
    $ duffing-env identify rig.toml data.csv --save posterior.npz
    $ duffing-env identify rig.toml data.csv --json > out.json
    """

    rig: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="RIG")]
    """Rig file, or the name of a rig that ships."""
    data: Annotated[
        tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="DATA", help_behavior_hint="(one or more)")
    ]
    """CSV or MAT files with the columns or variables u and y."""
    report: Annotated[Path | None, tyro.conf.arg(metavar="PATH")] = None
    """File for a page with figures, which opens without a network."""
    save: Annotated[Path | None, tyro.conf.arg(metavar="PATH")] = None
    """File for the belief, a NumPy archive (.npz), for duffing-env design, and estimator.load_estimator."""
    json: bool = False
    """Print JSON instead of the table."""

    def run(self) -> None:
        """Identify, print, and write the files."""
        from agents.console_output import print_in_80_columns
        from agents.output_paths import check_distinct_files
        from estimator import identify

        if Path(self.rig).suffix.lower() in (".csv", ".mat"):
            raise ValueError(
                f"rig must be a rig file, but is {self.rig}; write one: duffing-env rig init --from {self.rig}"
            )
        if not self.data:
            raise ValueError("data must name at least one CSV or MAT file; add it after the rig file")
        check_distinct_files({"save": self.save, "report": self.report}, [self.rig, *self.data])
        result = identify(self.rig, list(self.data), progress=True)
        # The result is printed also where the files cannot be written.
        try:
            if self.save is not None:
                from estimator.saving import save_estimator

                save_estimator(result.estimator, self.save)
            if self.report is not None:
                result.report(self.report, [shlex.join(["duffing-env", *sys.argv[1:]])])
        finally:
            if self.json:
                print(json.dumps(result_to_dict(result), indent=1))
            else:
                print_identification(result)
        if self.report is not None and not self.json:
            print_in_80_columns(f"The page is {self.report}")


def result_to_dict(result: Result) -> dict[str, Any]:
    """The content of the JSON output."""
    units, intervals = result.units, result.interval(0.9)
    return {
        "parameters": {
            name: {"mean": mean, "std": std, "low": intervals[name][0], "high": intervals[name][1], "unit": units[name]}
            for name, (mean, std) in result.parameters.items()
        },
        "noises": {name: {"mean": mean, "std": std} for name, (mean, std) in result.noises.items()},
        "warnings": [{"name": warning.name, "message": warning.message} for warning in result.warnings],
        "records": [
            {
                "name": record.name,
                "samples": len(record.u),
                "step": record.step or result.rig.step,
                "missing": record.n_missing,
                "clipped": record.n_clipped,
                "input": record.columns.input if record.columns else None,
                "output": record.columns.output if record.columns else None,
            }
            for record in result.records
        ],
        "rig": result.rig.to_dict(),
    }


def sampling_step_sentences(result: Result) -> list[str]:
    """Sentences with the sampling step of each record and its source."""
    steps_without_times = [one.step for one in result.records if one.times is None]
    agreement = (
        "and the times agree"
        if all(steps_without_times)
        else "as some records have no times"
        if any(steps_without_times)
        else "without times"
    )
    sentences = (
        [f"The sampling step is {_format_sampling_step(result.rig.step)} by the rig, {agreement}."]
        if steps_without_times
        else []
    )
    for record in result.records:
        if record.times is not None and record.step is not None:
            sentences.append(
                f"By its times {record.name.partition(', from sample ')[0]} has steps of "
                f"{_format_sampling_step(record.step)}."
            )
    return list(dict.fromkeys(sentences))


def column_sentences(result: Result) -> list[str]:
    """Sentences: which columns were taken, once for all files with the same names."""
    kind = result.rig.output.kind
    return list(dict.fromkeys(one.columns.sentence(kind) for one in result.records if one.columns))


def _format_sampling_step(step: float) -> str:
    return f"{step:.6g} s ({1 / step:.6g} Hz)"


def print_identification(result: Result) -> None:
    """Print the sampling step, the table of parameters, and the warnings."""
    from rich.text import Text

    from agents.console_output import format_table, rich_console
    from agents.console_output import print_texts_and_tables as print_all
    from estimator.rigs.units import format_interval
    from estimator.support.argument_checks import mask_control_codes

    units, intervals, rows = result.units, result.interval(0.9), []
    for name, (mean, _) in result.parameters.items():
        low, high = intervals[name]
        mean_text, low_text, high_text = format_interval(mean, low, high, 5)
        value = "open" if name in result.unidentified else mean_text
        rows.append([name, value, f"{low_text} to {high_text}", units[name]])
    print_all(
        *column_sentences(result),
        *sampling_step_sentences(result),
        "m x'' + c x' + a x + b x³ = u - u0 + w, measured with the offset y0",
        format_table(("", "mean", "90 % interval", "unit"), rows),
    )
    for warning in result.warnings:
        rich_console().print(Text.assemble((warning.name, "bold red"), f": {mask_control_codes(warning.message)}"))
    if not result.warnings:
        rich_console().print("No check speaks against this result.", style="green")
