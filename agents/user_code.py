"""Things of a user's own, named ``module:name``."""

from __future__ import annotations

import importlib
import sys
import traceback
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from types import BuiltinFunctionType, ModuleType
from typing import TYPE_CHECKING, Any

from estimator.support.optional_dependencies import EXTRA_OF_PACKAGE

if TYPE_CHECKING:
    from gymnasium.envs.registration import EnvSpec


def load_object(name_in_module: str, role: str) -> Any:
    """What stands at ``module:name``; a module in the working directory is found, too.

    Args:
        name_in_module: such as ``lab:plant``, for ``plant`` in lab.py.
        role: is looked for, in the messages.

    Raises:
        ValueError: naming what is wrong: no such module, one that cannot be imported, no such name in it, or a name
            that is a module, or as a policy a function of the system.
        ModuleNotFoundError: for a package of an extra that the module needs, and that is not there.
    """
    module, _, name = name_in_module.partition(":")
    if not module or not name:
        raise ValueError(
            f"{role} must be module:name, but is {name_in_module!r}; such as lab:{role}, for {role} in lab.py"
        )
    try:
        found = getattr(_import_module(module), name)
    except ModuleNotFoundError as error:
        if error.name is not None and module.startswith(error.name):
            raise ValueError(f"{role} must be module:name, but there is no module {module!r}: {error}") from error
        if _needs_extra(error):
            raise
        raise ValueError(f"{role} must be module:name, but {module} needs another package: {error}") from error
    except ImportError as error:
        raise ValueError(f"{role} must be module:name, but {module!r} cannot be imported: {error}") from error
    except AttributeError as error:
        raise ValueError(f"{role} must be module:name, but {module} has no {name!r}; name one it has") from error
    # A function of the system takes no observations, and may do anything with them.
    if isinstance(found, ModuleType) or (role == "policy" and isinstance(found, BuiltinFunctionType)):
        raise ValueError(
            f"{role} must be an object or a function of your own, but {name_in_module} is {found!r:.60}; name one"
        )
    return found


@contextmanager
def attribute_user_errors(name_in_module: Any, role: str) -> Iterator[None]:
    """Let an exception of user code name the object and the place: it may be no policy at all.

    Args:
        name_in_module: ``module:name``; of what has another name, faults are the program's.
        role: it is to be.

    Raises:
        ValueError: in place of any other exception.
    """
    try:
        yield
    except ValueError:
        raise
    except (Exception, SystemExit) as error:
        if not isinstance(name_in_module, str) or ":" not in name_in_module or _needs_extra(error):
            raise
        last = traceback.extract_tb(error.__traceback__)[-1]
        raise ValueError(
            f"{role} must be one, but {name_in_module} fails: {type(error).__name__}: {error} ({last.filename}, line "
            f"{last.lineno}); mend it, or name another"
        ) from error


def _needs_extra(error: BaseException) -> bool:
    return isinstance(error, ModuleNotFoundError) and str(error.name).split(".")[0] in EXTRA_OF_PACKAGE


#: What the commands pass on themselves where they make a track, beside the options.
_RESERVED_OPTIONS = ("id", "vectorization_mode", "seed", "levels")


def check_env_options(options: Mapping[str, Any]) -> None:
    """Refuse options of an environment that the one who makes it gives by itself.

    Raises:
        ValueError: naming the option.
    """
    from estimator.support.argument_checks import short_repr

    for name in _RESERVED_OPTIONS:
        if name in options:
            raise ValueError(f"options must not hold {name}, but {name} is {short_repr(options[name])}; leave it out")


def env_spec_of(env_id: str) -> EnvSpec:
    """What Gymnasium has registered under an id, of which ``module:`` is imported first, as ``gym.make`` does.

    Raises:
        ModuleNotFoundError: if there is no such module.
        gymnasium.error.Error: for an id that is not registered.
    """
    import gymnasium as gym

    module, _, name = env_id.rpartition(":")
    if module:
        _import_module(module)
    return gym.spec(name)


def _import_module(module: str) -> Any:
    """A module; whatever ends its import is an ImportError."""
    here = str(Path.cwd())
    if here not in sys.path:
        sys.path.append(here)
    try:
        return importlib.import_module(module)
    except ImportError:
        raise
    except (Exception, SystemExit) as error:
        raise ImportError(f"{type(error).__name__}: {error}") from error
