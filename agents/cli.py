"""What the command lines of the scripts share."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, TypeVar

import tyro
from gymnasium.error import Error as GymnasiumError
from tyro.constructors import PrimitiveConstructorSpec


def _parse_options(words: list[str]) -> dict[str, Any]:
    """The object that the first of the words holds as JSON; ValueError where it is none."""
    options = json.loads(words[0])
    if not isinstance(options, dict):
        raise ValueError(f"options must be a JSON object, but are {words[0]}; write e.g. '{{\"spread\": 0.2}}'")
    return options


#: A dictionary that is written as JSON on the command line: '{"spread": 0.2}'.
JsonOptions = Annotated[
    dict[str, Any],
    PrimitiveConstructorSpec(
        nargs=1,
        metavar="JSON",
        instance_from_str=_parse_options,
        is_instance=lambda value: isinstance(value, dict),
        str_from_instance=lambda value: [json.dumps(value)],
    ),
]

Config = TypeVar("Config")


def run_script(main: Callable[[Config], None], config: type[Config], description: str) -> None:
    """Parse the command line into ``config`` and call ``main`` with it.

    An error that the user can mend is printed as one message, with exit status 2 and no traceback.
    """
    try:
        main(tyro.cli(config, description=description))
    except (ValueError, OSError, GymnasiumError) as error:
        print(f"{Path(sys.argv[0]).name}: {error}", file=sys.stderr)
        sys.exit(2)
