"""What the command lines share: those of the scripts, and of ``duffing-env``."""

from __future__ import annotations

import atexit
import codecs
import gc
import io
import json
import os
import shutil
import sys
import textwrap
import unicodedata
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, redirect_stdout
from pathlib import Path
from signal import SIGINT
from typing import Annotated, Any, TypeVar

import tyro
from tyro.constructors import PrimitiveConstructorSpec

from agents.interruption import Interrupted, raise_on_sigterm
from agents.user_code import env_spec_of


def _parse_json_options(arguments: list[str]) -> dict[str, Any]:
    """The JSON object that the first of the words holds; ValueError where it is not one."""
    try:
        options = json.loads(arguments[0])
    except RecursionError:
        raise ValueError("options must be a JSON object, but are nested too deeply") from None
    if not isinstance(options, dict):
        raise ValueError(f"options must be a JSON object, but are {arguments[0]}; write e.g. '{{\"spread\": 0.2}}'")
    for name in ("num_envs", "autoreset_mode", "max_episode_steps", "threads", "copy", "render_mode"):
        if name in options:
            raise ValueError(f"options must not hold {name}, but are {arguments[0]}; the command chooses that itself")
    return options


#: A dictionary that is written as JSON on the command line: '{"spread": 0.2}'.
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

Config = TypeVar("Config")
Task = TypeVar("Task")

#: The track of a rig.
RIG_TRACK = "duffing_env/Rig-v0"


def options_with_rig(options: dict[str, Any], rig: str | None) -> dict[str, Any]:
    """Options of an environment, with the rig of a file, or one that ships, written out.

    Raises:
        ValueError: for a file that is not a rig's.
        FileNotFoundError: if there is no such file.
    """
    if rig is None:
        return options
    from estimator.rigs.rig import Rig

    return {**options, "rig": Rig.from_any(rig).to_dict()}


def iterate_with_progress(tasks: Iterable[tuple[str, Task]]) -> Iterator[Task]:
    """Tasks, one after the other; `estimator.support.progress.show_progress` names the one at hand."""
    from estimator.support.progress import show_progress

    tasks = list(tasks)
    with show_progress() as on_progress:
        for done, (name, task) in enumerate(tasks):
            on_progress(done / len(tasks), name)
            yield task


def check_distinct_files(outputs: Mapping[str, Path | None], inputs: Iterable[str | Path]) -> None:
    """Refuse to write over what a command reads, or two things into one file.

    Args:
        outputs: option to the file that it names, or None.
        inputs: files that the command reads; names of rigs that ship do no harm.

    Raises:
        ValueError: naming the option.
    """
    reasons = {Path(path).resolve(): "it is read" for path in inputs}
    for name, path in outputs.items():
        if path is not None:
            if path.resolve() in reasons:
                raise ValueError(
                    f"{name} must be a file of its own, but is {path}, and {reasons[path.resolve()]}; name another"
                )
            reasons[path.resolve()] = f"so is {name}"


def check_not_overwritten(name: str, path: Path | None, force: bool) -> None:
    """Refuse to replace a file that is there, but by force: it may be a measurement.

    Raises:
        ValueError: naming the option.
    """
    if path is not None and not force and path.exists():
        raise ValueError(f"{name} must be a new file, but there is {path}; name another, or add --force")


def full_track_id(env_id: Any) -> Any:
    """The id of a track by its name, without the module that registers it; anything else as it is.

    Example:
        >>> full_track_id("Short-v0"), full_track_id("duffing_env:duffing_env/Short-v0"), full_track_id("CartPole-v1")
        ('duffing_env/Short-v0', 'duffing_env/Short-v0', 'CartPole-v1')
    """
    from duffing_env import TRACKS

    env_id = env_id.removeprefix("duffing_env:") if isinstance(env_id, str) else env_id
    return f"duffing_env/{env_id}" if f"duffing_env/{env_id}" in TRACKS else env_id


def check_track_id(env_id: str) -> None:
    """Refuse an environment that has no vector environment of duffing_env, on which everything here is run.

    Raises:
        ValueError: for an environment of another package, or one that cannot be imported.
        gymnasium.error.Error: for an id that is not registered.
    """
    import gymnasium as gym
    from gymnasium.envs.registration import load_env_creator

    from duffing_env import TRACKS
    from duffing_env.vector_env import DuffingVectorEnv
    from estimator.support.argument_checks import did_you_mean, short_repr

    if not isinstance(env_id, str):
        raise ValueError(f"env must be the id of a track such as duffing_env/Short-v0, but is {short_repr(env_id)}")
    try:
        vector_env_class: Any = env_spec_of(env_id).vector_entry_point
        vector_env_class = load_env_creator(vector_env_class) if isinstance(vector_env_class, str) else vector_env_class
    except (ImportError, AttributeError) as error:
        raise ValueError(
            f"env must be the id of a track such as duffing_env/Short-v0, but is {env_id}: {error}"
        ) from error
    except gym.error.Error as error:
        remedy = "" if "/" in env_id else did_you_mean(f"duffing_env/{env_id}", TRACKS)
        raise type(error)(
            f"env must be the id of a track such as duffing_env/Short-v0: {str(error).rstrip('.')}{remedy}"
        ) from error
    if vector_env_class is None or (
        isinstance(vector_env_class, type) and not issubclass(vector_env_class, DuffingVectorEnv)
    ):
        raise ValueError(
            f"env must be a track, which has a vector environment of duffing_env, but is {env_id}; "
            "see the list at: python -c 'import duffing_env; print(*duffing_env.TRACKS)'"
        )


#: What letters become that an encoding has not; others lose their accents, or become question marks.
_ASCII_SUBSTITUTES = {
    "²": "^2", "³": "^3", "⁴": "^4", "⁻": "^-", "·": "*", "×": "x", "±": "+/-", "−": "-", "–": "-", "—": "-",
    "…": "...",
    "→": "->", "≤": "<=", "≥": ">=", "µ": "u", "μ": "u", "γ": "gamma", "ξ": "xi", "η": "eta", "θ": "theta",
    "σ": "sigma", "ω": "omega", "ρ": "rho", "Λ": "Lambda", "½": "1/2", "°": "deg", "•": "*", "─": "-", "━": "-",
    "│": "|", "┃": "|",
}  # fmt: skip


def _encode_error_handler(error: UnicodeError) -> tuple[str, int]:
    """What stands for letters that a stream cannot write."""
    if not isinstance(error, UnicodeEncodeError):
        raise error
    letters = error.object[error.start : error.end]
    return "".join(_ascii_form(letter) for letter in letters), error.end


def _ascii_form(letter: str) -> str:
    if letter in _ASCII_SUBSTITUTES or "\u2500" <= letter <= "\u257f":  # lines of boxes
        return _ASCII_SUBSTITUTES.get(letter, "+")
    plain = unicodedata.normalize("NFKD", letter).encode("ascii", "ignore").decode()
    return plain or "?"


codecs.register_error("legible", _encode_error_handler)


@contextmanager
def _terminal_output() -> Iterator[None]:
    """Print lines of 80 characters at most, and letters in any encoding."""
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="legible")
    before = os.environ.get("COLUMNS")
    os.environ["COLUMNS"] = str(min(80, shutil.get_terminal_size().columns))
    try:
        yield
    finally:
        del os.environ["COLUMNS"]
        if before is not None:
            os.environ["COLUMNS"] = before


def parse_arguments(settings_class: Any, **options: Any) -> Any:
    """What `tyro.cli` makes of the words; its help in lines of 80 characters, which it breaks only within boxes."""
    captured = io.StringIO()
    try:
        with redirect_stdout(captured):
            return tyro.cli(settings_class, **options)
    finally:
        for line in captured.getvalue().splitlines():
            print("\n".join(textwrap.wrap(line, 80, break_long_words=False, break_on_hyphens=False)) or line.strip())


@contextmanager
def one_line_errors(program_name: str) -> Iterator[None]:
    """End the process where the user can mend what went wrong, with one message and no traceback.

    The exit status is 2 for a bad value or file, or a package of an extra that is missing; 130 after Ctrl-C, and 143
    after SIGTERM.

    Args:
        program_name: of the command, which stands before the message.
    """
    # At the end of the process Python looks through all that Numba and torch have built, which takes 0.1 s and more.
    atexit.register(gc.freeze)
    try:
        with raise_on_sigterm(), _terminal_output():
            yield
    except (KeyboardInterrupt, Interrupted) as interruption:
        resume_hint = ""
        if isinstance(interruption, Interrupted) and interruption.resume_hint:
            from estimator.support.argument_checks import mask_control_codes

            resume_hint = f"; {mask_control_codes(interruption.resume_hint)}"
        print(f"{program_name}: stopped{resume_hint}", file=sys.stderr)
        sys.exit(128 + (interruption.signum if isinstance(interruption, Interrupted) else SIGINT))
    except Exception as error:
        from gymnasium.error import Error as GymnasiumError

        from estimator.support.argument_checks import mask_control_codes
        from estimator.support.optional_dependencies import EXTRA_OF_PACKAGE, install_hint

        if isinstance(error, ModuleNotFoundError) and (package := str(error.name).split(".")[0]) in EXTRA_OF_PACKAGE:
            print(f"{program_name}: {install_hint(package)}", file=sys.stderr)
        elif isinstance(error, ValueError | OSError | GymnasiumError):
            print(f"{program_name}: {mask_control_codes(' '.join(str(error).splitlines()))}", file=sys.stderr)
        else:
            raise
        sys.exit(2)


def run_script(main: Callable[[Config], object], config: type[Config], description: str | None = None) -> None:
    """Parse the command line into ``config`` and call ``main`` with it, `one_line_errors` where that fails.

    Args:
        main: what the script does.
        config: its settings, a dataclass.
        description: stands above the list of settings in the help; lines that begin with $ stay so. The docstring of
            ``config`` where it is None.
    """
    with one_line_errors(Path(sys.argv[0]).name):
        main(parse_arguments(config, description=description))
