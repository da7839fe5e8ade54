"""Command lines of the scripts and of ``duffing-env``: parsing, errors in one line, and output in any encoding."""

from __future__ import annotations

import atexit
import codecs
import gc
import io
import os
import shutil
import sys
import textwrap
import unicodedata
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stdout
from pathlib import Path
from signal import SIGINT
from typing import Any, TypeVar

import tyro

from agents.interruption import Interrupted, raise_on_sigterm

Config = TypeVar("Config")


#: Replacements of letters that an encoding does not have; other letters lose their accents or become "?".
_ASCII_SUBSTITUTES = {
    "²": "^2", "³": "^3", "⁴": "^4", "⁻": "^-", "·": "*", "×": "x", "±": "+/-", "−": "-", "–": "-", "—": "-",
    "…": "...",
    "→": "->", "≤": "<=", "≥": ">=", "µ": "u", "μ": "u", "γ": "gamma", "ξ": "xi", "η": "eta", "θ": "theta",
    "σ": "sigma", "ω": "omega", "ρ": "rho", "Λ": "Lambda", "½": "1/2", "°": "deg", "•": "*", "─": "-", "━": "-",
    "│": "|", "┃": "|",
}  # fmt: skip


def _encode_error_handler(error: UnicodeError) -> tuple[str, int]:
    """Replace letters that a stream cannot encode."""
    if not isinstance(error, UnicodeEncodeError):
        raise error
    letters = error.object[error.start : error.end]
    return "".join(_ascii_form(letter) for letter in letters), error.end


def _ascii_form(letter: str) -> str:
    if letter in _ASCII_SUBSTITUTES or "\u2500" <= letter <= "\u257f":  # box drawing
        return _ASCII_SUBSTITUTES.get(letter, "+")
    plain = unicodedata.normalize("NFKD", letter).encode("ascii", "ignore").decode()
    return plain or "?"


codecs.register_error("legible", _encode_error_handler)


@contextmanager
def _terminal_output() -> Iterator[None]:
    """Limit lines to 80 characters, and let every letter be printed in any encoding."""
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
    """Parse arguments by `tyro.cli`; the help is printed in lines of at most 80 characters."""
    captured = io.StringIO()
    try:
        with redirect_stdout(captured):
            return tyro.cli(settings_class, **options)
    finally:
        for line in captured.getvalue().splitlines():
            print("\n".join(textwrap.wrap(line, 80, break_long_words=False, break_on_hyphens=False)) or line.strip())


@contextmanager
def one_line_errors(program_name: str) -> Iterator[None]:
    """End the process with a message of one line and no traceback, after an error that the user can correct.

    The exit status is 2 for a bad value or file, or a missing package of an extra; 130 after Ctrl-C, and 143 after
    SIGTERM.

    Args:
        program_name: stands before the message.
    """
    # Without this, a garbage collection over the objects of Numba and torch takes 0.1 s or more at the exit.
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
    """Parse the command line into ``config`` and call ``main`` with it, within `one_line_errors`.

    Args:
        main: function of the script.
        config: dataclass of its settings.
        description: above the settings in the help, where lines that begin with $ stay as they are; None: the docstring
            of ``config``.
    """
    with one_line_errors(Path(sys.argv[0]).name):
        main(parse_arguments(config, description=description))
