"""An instrument as a plant, over PyVISA: what it is told stands in the table ``[instrument]`` of the rig file."""

from __future__ import annotations

import string
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import numpy.typing as npt

from estimator.checks import number, shown
from estimator.extras import need
from estimator.parameters import FloatArray
from estimator.rig import Rig

#: What each command may have in braces.
_FIELDS = {"set": {"u"}, "watchdog": {"seconds"}, "upload": {"values"}}


@dataclass(frozen=True)
class Commands:
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
        number("instrument.timeout", self.timeout, 1e-3, 3600.0)
        if not isinstance(self.begin, list | tuple) or not all(isinstance(line, str) for line in self.begin):
            raise ValueError(f"instrument.begin must be a list of texts, such as ['*RST'], but is {shown(self.begin)}")
        for one in fields(self):
            value, allowed = getattr(self, one.name), _FIELDS.get(one.name, set())
            if one.name in ("timeout", "begin") or (value is None and one.default is None):
                continue
            if not isinstance(value, str):
                raise ValueError(f"instrument.{one.name} must be a text, but is {shown(value)}")
            if one.name in ("resource", "termination", "backend"):
                continue
            found = {name for _, name, _, _ in string.Formatter().parse(value) if name is not None}
            if found != allowed:
                raise ValueError(
                    f"instrument.{one.name} must have {sorted(allowed)} in braces, but has {sorted(found)}: {value!r}"
                )


class Instrument:
    """A plant that is an instrument. The connection is kept until the program ends, or `close`.

    Args:
        rig: of which the step is taken, to wait for blocks.
        commands: what it is told.

    Raises:
        ImportError: without PyVISA: ``pip install 'duffing-env[instrument]'``.
        ValueError: if there is no connection.
    """

    def __init__(self, rig: Rig, commands: Commands) -> None:
        need("pyvisa")
        import pyvisa

        self._commands, self._step = commands, rig.step
        self.watches = commands.watchdog is not None
        # The manager stays open: PyVISA shares it, and to close it would cut off other instruments.
        link: Any = None
        try:
            ends = {"read_termination": commands.termination, "write_termination": commands.termination}
            manager: Any = pyvisa.ResourceManager(commands.backend)
            self._link = link = manager.open_resource(commands.resource, **ends)
            link.timeout = 1000 * commands.timeout
            for line in (*commands.begin, commands.zero):
                link.write(line)
        except Exception as error:  # each backend has its own
            if link is not None:
                link.close()
            raise ValueError(f"instrument.resource {commands.resource!r} cannot be opened: {error}") from error

    def __repr__(self) -> str:
        return f"Instrument({self._commands.resource!r})"

    def arm(self, watchdog: float | None) -> None:
        """The watchdog first, then let inputs through."""
        if watchdog is not None:
            self._link.write(self._needed("watchdog").format(seconds=watchdog))
        self._link.write(self._commands.arm)

    def apply(self, u: float) -> float:
        """Set the input; the answer is what is applied, where there is one."""
        line = self._needed("set").format(u=u)
        if line.endswith("?"):
            return float(self._link.query(line))
        self._link.write(line)
        return u

    def read(self) -> float:
        """Ask for the output."""
        return float(self._link.query(self._needed("read")))

    def play(self, u: FloatArray) -> tuple[npt.ArrayLike, npt.ArrayLike]:
        """Upload, play, wait, ask."""
        self._link.write(self._needed("upload").format(values=",".join(map(repr, u.tolist()))))
        self._link.write(self._needed("play"))
        usual, self._link.timeout = self._link.timeout, self._link.timeout + 1000 * len(u) * self._step
        try:
            y = self._numbers(self._needed("outputs"))
        finally:  # what zeroes the input next must not wait for so long
            self._link.timeout = usual
        return u if self._commands.inputs is None else self._numbers(self._commands.inputs), y

    def zero(self) -> None:
        """The input to zero."""
        self._link.write(self._commands.zero)

    def disarm(self) -> None:
        """No input any more."""
        self._link.write(self._commands.disarm)

    def close(self) -> None:
        """End the connection."""
        self._link.close()

    def _numbers(self, question: str) -> FloatArray:
        return np.array([float(word) for word in self._link.query(question).split(",")])

    def _needed(self, name: str) -> str:
        value = getattr(self._commands, name)
        if value is None:
            raise ValueError(f"instrument.{name} must be in the rig file for this, but is not; add it")
        return str(value)


def plant(rig: Rig, **instrument: Any) -> Instrument:
    """For ``--plant agents.running.instrument:plant``: that of the table ``[instrument]``.

    Raises:
        ValueError: as `Commands` and `Instrument`, or for a key that is unknown or missing.
    """
    known = {one.name for one in fields(Commands)}
    missing = {"resource", "zero", "arm", "disarm"} - set(instrument)
    if missing or set(instrument) - known:
        raise ValueError(
            f"instrument must be a table of the rig file with keys of {sorted(known)}, but lacks {sorted(missing)} and "
            f"has {sorted(set(instrument) - known)}"
        )
    return Instrument(rig, Commands(**instrument))
