"""Hyperparameter files in TOML: a table for each track, and a default table for the others."""

from __future__ import annotations

import json
import tomllib
from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any, TypeVar

from agents.training.algorithms import ALGORITHMS, AlgorithmSettings, hyperparameters_to_dict
from agents.training.environments.oscillator_family import FAMILY
from estimator.support.argument_checks import check_choice, did_you_mean, mask_control_codes
from estimator.support.file_io import check_readable_file, write_atomically

#: Folder of the files ``ALGORITHM.toml`` that come with the package.
HYPERPARAMETER_FOLDER = Path(__file__).parents[1] / "hyperparameters"

#: Table of the tracks without a table of their own.
DEFAULT_TABLE = "default"

_TYPE_NAMES: dict[type, str] = {
    int: "a whole number", float: "a number", tuple: "a list of whole numbers", str: "a name", bool: "true or false"
}  # fmt: skip

Settings = TypeVar("Settings")


def track_name(env_id: str) -> str:
    """The name of a track without its module and namespace: "Amplitude-v0"."""
    return env_id.rpartition(":")[2].split("/")[-1]


def table_name(env_id: str) -> str:
    """The name of a track's table, which all its versions share, such as "Amplitude"; else its own name."""
    return track_name(env_id).rpartition("-v")[0] or env_id


def read_hyperparameters(algo: str, env_id: str, path: Path | None = None) -> AlgorithmSettings:
    """The hyperparameters of an algorithm on a track: its defaults, overridden by the default and the track's table.

    Args:
        algo: a name in `ALGORITHMS`.
        env_id: of the track.
        path: of the file; None: the package's file.

    Raises:
        ValueError: for an unknown algorithm, a file that is not TOML or has an entry that is no hyperparameter, or a
            file of your own that has no table for the track.
        OSError: where the file cannot be read.
    """
    check_choice("algo", algo, ALGORITHMS)
    file = HYPERPARAMETER_FOLDER / f"{algo}.toml" if path is None else path
    try:
        tables = tomllib.loads(
            check_readable_file(file, "settings must be a TOML file", 2**20).read_text(encoding="utf-8")
        )
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, RecursionError) as error:
        raise ValueError(f"settings must be a TOML file, but {file} is not: {error}") from error
    for table, entries in tables.items():
        _check_hyperparameter_table(table, entries, ALGORITHMS[algo], file)
    if path is not None and not {DEFAULT_TABLE, table_name(env_id)} & set(tables):
        raise ValueError(
            f"settings must have a table [{table_name(env_id)}] or [{DEFAULT_TABLE}] for {env_id}, but {path} has "
            f"{', '.join(f'[{table}]' for table in tables) or 'none'}; name the track with --env, or add one"
        )
    return parse_hyperparameters(ALGORITHMS[algo], tables.get(DEFAULT_TABLE, {}) | tables.get(table_name(env_id), {}))


def parse_hyperparameters(settings_class: type[Settings], entries: Mapping[str, Any]) -> Settings:
    """Hyperparameters from the entries of a JSON or TOML file.

    Raises:
        ValueError: for an entry that is no hyperparameter, or a value of another type.
    """
    defaults: dict[str, Any] = {f.name: getattr(settings_class(), f.name) for f in fields(settings_class)}  # type: ignore[arg-type]
    values: dict[str, Any] = {}
    for name, value in entries.items():
        if name not in defaults:
            raise ValueError(f"{name} is no hyperparameter of {settings_class.__name__}{did_you_mean(name, defaults)}")
        field_type = type(defaults[name])
        if field_type is float and type(value) is int:
            value = float(value)
        if field_type is tuple and isinstance(value, list) and all(type(units) is int for units in value):
            value = tuple(value)
        if type(value) is not field_type:
            raise ValueError(f"{name} must be {_TYPE_NAMES[field_type]}, but is {value!r}")
        values[name] = value
    return settings_class(**values)


def write_hyperparameters(path: Path, env_id: str, settings: AlgorithmSettings, comment: str) -> None:
    """Write a file that `read_hyperparameters` reads, with these hyperparameters for this track."""
    lines = [f"# {mask_control_codes(comment)}", f"[{table_name(env_id)}]"]
    lines += [f"{name} = {json.dumps(value)}" for name, value in hyperparameters_to_dict(settings).items()]
    write_atomically(path, "\n".join(lines) + "\n")


def _check_hyperparameter_table(table: str, entries: Any, settings_class: type[AlgorithmSettings], path: Path) -> None:
    """Refuse a table of no registered track, and bad entries in any table."""
    from gymnasium import registry

    import duffing_env  # noqa: F401  registers the tracks

    if not isinstance(entries, dict):
        raise ValueError(f"settings must be in tables such as [{DEFAULT_TABLE}], but {path} has {table} in none")
    if table not in [DEFAULT_TABLE, FAMILY, *map(table_name, registry)]:
        known_tables = [
            DEFAULT_TABLE,
            *dict.fromkeys(table_name(name) for name in registry if name.startswith("duffing_env/")),
        ]
        raise ValueError(
            f"settings must have tables [{DEFAULT_TABLE}] or of tracks, but {path} has [{table}]"
            f"{did_you_mean(table, known_tables)}"
        )
    try:
        parse_hyperparameters(settings_class, entries)
    except ValueError as error:
        raise ValueError(f"{error}; mend [{table}] of {path}") from error
