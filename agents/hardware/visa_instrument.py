"""A SCPI instrument as a plant, over PyVISA; its commands stand in the table ``[instrument]`` of the rig file."""

from __future__ import annotations

import string
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from estimator.rigs.rig import Rig
from estimator.support.argument_checks import check_number, short_repr
from estimator.support.array_types import FloatArray
from estimator.support.optional_dependencies import require_packages

#: Placeholders in braces that each command has; the others have none.
_PLACEHOLDERS = {"set": {"u"}, "watchdog": {"seconds"}, "upload": {"values"}}


class _MessageSession(Protocol):
    """The part of PyVISA's message-based resource that is used here."""

    timeout: float

    def write(self, message: str) -> object: ...
    def query(self, message: str) -> str: ...
    def close(self) -> None: ...


@dataclass(frozen=True)
class VisaCommands:
    """The table ``[instrument]``.

    Attributes:
        resource: VISA's name, such as ``TCPIP::192.168.0.7::5025::SOCKET`` or ``ASRL/dev/ttyUSB0::INSTR``.
        zero: command that brings the input to zero.
        arm: command that lets inputs through.
        disarm: command that lets no input through.
        watchdog: command that lets the instrument zero its input after ``{seconds}`` of silence; None: it cannot.
        set: command that applies the input ``{u}``; a run by samples needs ``set`` and ``read``. Where it ends with a
            question mark, such as ``SOUR:VOLT {u};:SOUR:VOLT?``, the answer is the applied input. Over a network it
            should: the message after one without an answer may wait for 40 ms (Nagle's algorithm).
        read: query of the output.
        upload: command that sends the inputs ``{values}`` of a block, separated by commas; a run by blocks needs
            ``upload``, ``play`` and ``outputs``.
        play: command that plays the block, one input per sampling step, then zero.
        outputs: query of the block's outputs, separated by commas, after it has been played.
        inputs: query of the inputs as they were applied; None: they are taken to be the inputs that were sent.
        begin: commands that follow the opening of the connection, before ``zero``.
        timeout: seconds that an answer may take, from 0.001 to 3600.
        termination: end of a line, in both directions.
        backend: PyVISA's backend; ``@py`` is pyvisa-py.

    Raises:
        ValueError: for a command with other placeholders than named above, or a value of another type.
    """

    resource: str
    zero: str
    arm: str
    disarm: str
    watchdog: str | None = None
    set: str | None = None
    read: str | None = None
    upload: str | None = None
    play: str | None = None
    outputs: str | None = None
    inputs: str | None = None
    begin: Sequence[str] = ()
    timeout: float = 2.0
    termination: str = "\n"
    backend: str = "@py"

    def __post_init__(self) -> None:
        check_number("instrument.timeout", self.timeout, 1e-3, 3600.0)
        if not isinstance(self.begin, list | tuple) or not all(isinstance(line, str) for line in self.begin):
            raise ValueError(
                f"instrument.begin must be a list of texts, such as ['*RST'], but is {short_repr(self.begin)}"
            )
        for field in fields(self):
            value, allowed = getattr(self, field.name), _PLACEHOLDERS.get(field.name, set())
            if field.name in ("timeout", "begin") or (value is None and field.default is None):
                continue
            if not isinstance(value, str):
                raise ValueError(f"instrument.{field.name} must be a text, but is {short_repr(value)}")
            if field.name in ("resource", "termination", "backend"):
                continue
            placeholders = {name for _, name, _, _ in string.Formatter().parse(value) if name is not None}
            if placeholders != allowed:
                raise ValueError(
                    f"instrument.{field.name} must have {sorted(allowed)} in braces, but has {sorted(placeholders)}: "
                    f"{value!r}"
                )


class VisaInstrument:
    """An instrument as a plant. The connection stays open until `close` or the end of the program.

    Args:
        rig: whose sampling step says how long a block takes.
        commands: messages of the instrument.

    Raises:
        ImportError: without PyVISA: ``pip install 'duffing-env[instrument]'``.
        ValueError: if there is no connection.
    """

    def __init__(self, rig: Rig, commands: VisaCommands) -> None:
        require_packages("pyvisa")
        import pyvisa

        self._commands, self._step = commands, rig.step
        self.has_watchdog = commands.watchdog is not None
        # The manager stays open: PyVISA shares it, and to close it would cut off other instruments.
        connection: _MessageSession | None = None
        try:
            terminations = {"read_termination": commands.termination, "write_termination": commands.termination}
            manager: Any = pyvisa.ResourceManager(commands.backend)
            connection = manager.open_resource(commands.resource, **terminations)
            assert connection is not None
            self._connection = connection
            connection.timeout = 1000 * commands.timeout
            for line in (*commands.begin, commands.zero):
                connection.write(line)
        except Exception as error:  # each backend has its own
            if connection is not None:
                connection.close()
            raise ValueError(f"instrument.resource {commands.resource!r} cannot be opened: {error}") from error

    def __repr__(self) -> str:
        return f"VisaInstrument({self._commands.resource!r})"

    def arm(self, watchdog: float | None) -> None:
        """Set the watchdog, then let inputs through."""
        if watchdog is not None:
            self._connection.write(self._required_command("watchdog").format(seconds=watchdog))
        self._connection.write(self._commands.arm)

    def apply(self, u: float) -> float:
        """Set the input; returns the answer, or ``u`` where the command has none."""
        line = self._required_command("set").format(u=u)
        if line.endswith("?"):
            return float(self._connection.query(line))
        self._connection.write(line)
        return u

    def read(self) -> float:
        """Query the output."""
        return float(self._connection.query(self._required_command("read")))

    def play(self, u: FloatArray) -> tuple[npt.ArrayLike, npt.ArrayLike]:
        """Upload the block, play it, and query the outputs when it has ended."""
        self._connection.write(self._required_command("upload").format(values=",".join(map(repr, u.tolist()))))
        self._connection.write(self._required_command("play"))
        normal_timeout = self._connection.timeout
        self._connection.timeout = normal_timeout + 1000 * len(u) * self._step
        try:
            y = self._query_numbers(self._required_command("outputs"))
        finally:  # the command that zeroes the input next must not wait as long
            self._connection.timeout = normal_timeout
        return u if self._commands.inputs is None else self._query_numbers(self._commands.inputs), y

    def zero(self) -> None:
        """Bring the input to zero."""
        self._connection.write(self._commands.zero)

    def disarm(self) -> None:
        """Let no input through any more."""
        self._connection.write(self._commands.disarm)

    def close(self) -> None:
        """Close the connection."""
        self._connection.close()

    def _query_numbers(self, query: str) -> FloatArray:
        return np.array([float(word) for word in self._connection.query(query).split(",")])

    def _required_command(self, command: str) -> str:
        value = getattr(self._commands, command)
        if value is None:
            raise ValueError(f"instrument.{command} must be in the rig file for this run, but is not; add it")
        return str(value)


def plant(rig: Rig, **instrument: Any) -> VisaInstrument:
    """The factory of ``--plant agents.hardware.visa_instrument:plant``: an instrument by the table ``[instrument]``.

    Raises:
        ValueError: as of `VisaCommands` and `VisaInstrument`, or for a key that is unknown or missing.
    """
    known = {one.name for one in fields(VisaCommands)}
    missing = {"resource", "zero", "arm", "disarm"} - set(instrument)
    if missing or set(instrument) - known:
        raise ValueError(
            f"instrument must be a table of the rig file with keys of {sorted(known)}, but lacks {sorted(missing)} and "
            f"has {sorted(set(instrument) - known)}"
        )
    return VisaInstrument(rig, VisaCommands(**instrument))
