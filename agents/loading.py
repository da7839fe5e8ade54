"""Things of a user's own, named ``module:name``."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from gymnasium.envs.registration import EnvSpec


def load_object(place: str, what: str) -> Any:
    """What stands at ``module:name``; a module in the working directory is found, too.

    Args:
        place: such as ``lab:plant``, for ``plant`` in lab.py.
        what: is looked for, in the messages.

    Raises:
        ValueError: naming what is wrong: no such module, or no such name in it.
    """
    module, _, name = place.partition(":")
    if not module or not name:
        raise ValueError(f"{what} must be module:name, but is {place!r}; such as lab:{what}, for {what} in lab.py")
    try:
        return getattr(_imported(module), name)
    except ModuleNotFoundError as error:
        if error.name is None or not module.startswith(error.name):
            raise
        raise ValueError(f"{what} must be module:name, but there is no module {module!r}: {error}") from error
    except AttributeError as error:
        raise ValueError(f"{what} must be module:name, but {module} has no {name!r}; name one it has") from error


#: What the commands pass on themselves where they make a track, beside the options.
_PASSED = ("id", "vectorization_mode", "seed", "levels")


def check_options(options: Mapping[str, Any]) -> None:
    """Refuse options of an environment that the one who makes it gives by itself.

    Raises:
        ValueError: naming the option.
    """
    from estimator.checks import shown

    for name in _PASSED:
        if name in options:
            raise ValueError(f"options must not hold {name}, but {name} is {shown(options[name])}; leave it out")


def spec_of(env_id: str) -> EnvSpec:
    """What Gymnasium has registered under an id, of which ``module:`` is imported first, as ``gym.make`` does.

    Raises:
        ModuleNotFoundError: if there is no such module.
        gymnasium.error.Error: for an id that is not registered.
    """
    import gymnasium as gym

    module, _, name = env_id.rpartition(":")
    if module:
        _imported(module)
    return gym.spec(name)


def _imported(module: str) -> Any:
    here = str(Path.cwd())
    if here not in sys.path:
        sys.path.append(here)
    return importlib.import_module(module)
