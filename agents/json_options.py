"""Options of an environment as one JSON object on a command line: the annotation that tyro parses."""

from __future__ import annotations

import json
from typing import Annotated, Any

from tyro.constructors import PrimitiveConstructorSpec


def _parse_json_options(arguments: list[str]) -> dict[str, Any]:
    """Parse the first argument as a JSON object; ValueError for anything else, or a name that the command sets."""
    try:
        options = json.loads(arguments[0])
    except RecursionError:
        raise ValueError("options must be a JSON object, but are nested too deeply") from None
    if not isinstance(options, dict):
        raise ValueError(f"options must be a JSON object, but are {arguments[0]}; write e.g. '{{\"spread\": 0.2}}'")
    for name in ("num_envs", "autoreset_mode", "max_episode_steps", "threads", "copy", "render_mode"):
        if name in options:
            raise ValueError(f"options must not hold {name}, but are {arguments[0]}; the command sets it itself")
    return options


#: A dictionary that is JSON on the command line: '{"spread": 0.2}'.
JsonOptions = Annotated[
    dict[str, Any],
    PrimitiveConstructorSpec(
        nargs=1,
        metavar="JSON",
        instance_from_str=_parse_json_options,
        is_instance=lambda value: isinstance(value, dict),
        str_from_instance=lambda value: [json.dumps(value)],
    ),
]
