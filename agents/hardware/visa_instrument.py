"""An instrument as a plant, over PyVISA: what it is told stands in the table ``[instrument]`` of the rig file."""

from __future__ import annotations

import string
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import numpy.typing as npt

from estimator.rigs.rig import Rig
from estimator.support.argument_checks import check_number, short_repr
from estimator.support.array_types import FloatArray
from estimator.support.optional_dependencies import require_packages

#: What each command may have in braces.
_PLACEHOLDERS = {"set": {"u"}, "watchdog": {"seconds"}, "upload": {"values"}}


@dataclass(frozen=True)
class VisaCommands:
    """The table ``[instrument]``.

    Attributes:
        resource: VISA's name, such as ``TCPIP::192.168.0.7::5025::SOCKET`` or ``ASRL/dev/ttyUSB0::INSTR``.
        zero: command that brings the input to zero.
        arm: that lets inputs through.
        disarm: that lets none through.
        watchdog: after ``{seconds}`` of silence the instrument is to zero its input; left out where it cannot.
        set: applies the input ``{u}``; a run by samples needs it, and ``read``. Where it ends with a question, such as
            ``SOUR:VOLT {u};:SOUR:VOLT?``, the answer is the input that is applied. Over a network it should: what comes
            after a message without an answer may wait for 40 ms (Nagle's algorithm).
        read: asks for the output.
        upload: sends the inputs ``{values}`` of a block, separated by commas; a run by blocks needs it and these:
        play: plays them, one a sampling step, then zero.
        outputs: asks for the outputs of the block, separated by commas, when it has been played.
        inputs: asks for the inputs as they were applied; those sent are taken for them where this is left out.
        begin: a list of commands when it is opened; ``zero`` follows.
        timeout: seconds that an answer may take, from 0.001 to 3600.
        termination: what ends a line, both ways.
        backend: of PyVISA; ``@py`` is pyvisa-py.

    Raises:
        ValueError: for a command whose braces are not as above, or a value that is none.
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
                    f"instrument.{field.name} must have {sorted(allowed)} in braces, but has {sorted(placeholders)}: {value!r}"
                )


class VisaInstrument:
    """A plant that is an instrument. The connection is kept until the program ends, or `close`.

    Args:
        rig: of which the step is taken, to wait for blocks.
        commands: what it is told.

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
        connection: Any = None
        try:
            terminations = {"read_termination": commands.termination, "write_termination": commands.termination}
            manager: Any = pyvisa.ResourceManager(commands.backend)
            self._connection = connection = manager.open_resource(commands.resource, **terminations)
            connection.timeout = 1000 * commands.timeout
            for line in (*commands.begin, commands.zero):
                connection.write(line)
        except Exception as error:  # each backend has its own
            if connection is not None:
                connection.close()
            raise ValueError(f"instrument.resource {commands.resource!r} cannot be opened: {error}") from error

    def __repr__(self) -> str:
        return f"Instrument({self._commands.resource!r})"

    def arm(self, watchdog: float | None) -> None:
        """The watchdog first, then let inputs through."""
        if watchdog is not None:
            self._connection.write(self._required_command("watchdog").format(seconds=watchdog))
        self._connection.write(self._commands.arm)

    def apply(self, u: float) -> float:
        """Set the input; the answer is what is applied, where there is one."""
        line = self._required_command("set").format(u=u)
        if line.endswith("?"):
            return float(self._connection.query(line))
        self._connection.write(line)
        return u

    def read(self) -> float:
        """Ask for the output."""
        return float(self._connection.query(self._required_command("read")))

    def play(self, u: FloatArray) -> tuple[npt.ArrayLike, npt.ArrayLike]:
        """Upload, play, wait, ask."""
        self._connection.write(self._required_command("upload").format(values=",".join(map(repr, u.tolist()))))
        self._connection.write(self._required_command("play"))
        normal_timeout, self._connection.timeout = (
            self._connection.timeout,
            self._connection.timeout + 1000 * len(u) * self._step,
        )
        try:
            y = self._query_numbers(self._required_command("outputs"))
        finally:  # what zeroes the input next must not wait for so long
            self._connection.timeout = normal_timeout
        return u if self._commands.inputs is None else self._query_numbers(self._commands.inputs), y

    def zero(self) -> None:
        """The input to zero."""
        self._connection.write(self._commands.zero)

    def disarm(self) -> None:
        """No input any more."""
        self._connection.write(self._commands.disarm)

    def close(self) -> None:
        """End the connection."""
        self._connection.close()

    def _query_numbers(self, query: str) -> FloatArray:
        return np.array([float(word) for word in self._connection.query(query).split(",")])

    def _required_command(self, command: str) -> str:
        value = getattr(self._commands, command)
        if value is None:
            raise ValueError(f"instrument.{command} must be in the rig file for this, but is not; add it")
        return str(value)


def plant(rig: Rig, **instrument: Any) -> VisaInstrument:
    """For ``--plant agents.hardware.visa_instrument:plant``: that of the table ``[instrument]``.

    Raises:
        ValueError: as `VisaCommands` and `VisaInstrument`, or for a key that is unknown or missing.
    """
    known = {one.name for one in fields(VisaCommands)}
    missing = {"resource", "zero", "arm", "disarm"} - set(instrument)
    if missing or set(instrument) - known:
        raise ValueError(
            f"instrument must be a table of the rig file with keys of {sorted(known)}, but lacks {sorted(missing)} and "
            f"has {sorted(set(instrument) - known)}"
        )
    return VisaInstrument(rig, VisaCommands(**instrument))
