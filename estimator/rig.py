"""The rig: how an oscillator stands in the world. Units, sampling step and scales are here, and nowhere else."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from estimator.checks import hint, number, one_of, printable, shown, whole
from estimator.files import file_name, whole_file, write_atomically
from estimator.models.duffing import KINDS, duffing
from estimator.models.model import Model
from estimator.units import SIZES, Scales, kind_of

#: How the input goes between samples, and the degree of the polynomial that each takes.
INTERPOLATIONS = {"zero_order": 0, "linear": 1, "look_ahead": 5, "spline": 5}

#: Those of which the input may act a part of a sample later.
PARTS = ("zero_order", "linear", "spline")

#: More samples of delay are a record that was not aligned.
LONGEST_DELAY = 1000

#: No rig file is larger [bytes].
_LARGEST_FILE = 2**20

#: Rigs that come with the package: name to file.
SHIPPED = {path.stem: path for path in sorted((Path(__file__).parent / "rigs").glob("*.toml"), key=lambda p: p.stem)}

_PARAMETERS = ("m", "c", "a", "b")


@dataclass(frozen=True)
class Channel:
    """The input or the output of a rig.

    Attributes:
        unit: such as ``"N"``, ``"V"``, ``"mm"`` or ``"m/s"``.
        limit: of an input: never exceeded, in either direction. None: not known.
        range: of an output: an experiment stops outside of it, in either direction. None: not known.
        kind: what an output shows: ``displacement``, ``velocity`` or ``acceleration``.
        noise: standard deviation, per sample: of an output its sensor's, of an input what disturbs the force. A first
            value of what stays unknown; None: nothing is known of it.
        offset: first value of the offset, which stays unknown. `identify` takes outputs that lie far from 0 as they
            are; a rig that is played has a range about 0.
        lag: of an input: time constant [s] of a first-order lag between what is recorded and what acts, such as of a
            voice coil. For `identify` alone. None: none.
        column: its name in CSV files, with or without the unit behind it, or in MAT files. None stands for the usual
            names (`estimator.identification.tables.read_table`).

    Raises:
        ValueError: naming the argument, the value and the remedy.
    """

    unit: str = "1"
    limit: float | None = None
    range: float | None = None
    kind: str = "displacement"
    noise: float | None = None
    offset: float = 0.0
    column: str | None = None
    lag: float | None = None

    def __post_init__(self) -> None:
        if not isinstance(self.unit, str) or not self.unit.strip() or len(self.unit) > 40:
            raise ValueError(f"unit must be a short text such as 'N', but is {self.unit!r:.60}; '1' is a pure number")
        if printable(self.unit) != self.unit or set(self.unit) & set(',;"[]'):  # it stands in heads of CSV files
            raise ValueError(f"unit must hold no control codes, commas, quotes or brackets, but is {self.unit!r:.60}")
        for name in ("limit", "range", "noise", "lag"):
            value = getattr(self, name)
            if value is not None:
                of = {"limit": " of an input", "range": " of an output"}.get(name, "")
                number(f"{name}{of}", value, *SIZES, "leave it out where it is not known")
        one_of("kind", self.kind, KINDS)
        number("offset", self.offset, -SIZES[1], SIZES[1], "0 where nothing is known")
        if self.column is not None:
            if not isinstance(self.column, str) or not 0 < len(self.column.strip()) <= 80:
                raise ValueError(f"column must be a name in the records' files, but is {self.column!r:.60}")
            if printable(self.column) != self.column or set(self.column) & set(',;"'):
                raise ValueError(f"column must hold no control codes, commas or quotes, but is {self.column!r:.60}")


@dataclass(frozen=True)
class Rig:
    """Sampling step, input and output of an oscillator, and what is guessed of it. u and y are paired by index.

    Attributes:
        step: sampling step [s].
        interpolation: of the input of a differential equation; a difference equation has taps instead. ``zero_order``:
            u[k] acts from sample k to k + 1, and is first seen in y[k+1]: an accelerometer, too, shows y[k] just before
            the input goes to u[k]. ``linear``: from u[k-1] to u[k]. Both are causal, and the input before the first was
            0. ``look_ahead``: the quintic spline through the last nine inputs and the next one, so that a sample is
            used when the next input is known. ``spline``: the quintic spline through all inputs, for recorded data that
            is given at once. Before their first input it was the same.
        delay: samples by which the input acts later than that. A difference equation's newest tap acts on y[k] with
            u[k - delay]: 1 for the paper's in recorded data. -1 is for ``zero_order`` alone, where pairs are those of
            an environment: u[k] acted before y[k]. `identify` takes parts of a sample, from above -1 on.
        input: its unit, limit, noise and offset.
        output: its unit, kind, range, noise and offset.
        guess: parameter m, c, a, b to the central 90 % interval of what is believed of it, in the units of the
            channels; of any sign, but m is positive. None: nothing is known.

    Raises:
        ValueError: naming the argument, the value and the remedy.

    Example:
        >>> from estimator import Channel, Rig
        >>> rig = Rig(step=1e-3, input=Channel("N", limit=20), output=Channel("m", range=0.03))
        >>> rig.delay, rig.scales.unit((1, -3, 0))
        (0, 'N/m³')
    """

    step: float
    interpolation: str = "zero_order"
    delay: float = 0
    input: Channel = field(default_factory=Channel)
    output: Channel = field(default_factory=Channel)
    guess: Mapping[str, tuple[float, float]] | None = None

    def __post_init__(self) -> None:
        number("step", self.step, *SIZES, "give the seconds between samples")
        one_of("interpolation", self.interpolation, INTERPOLATIONS)
        least = -1 if self.interpolation == "zero_order" else 0
        if isinstance(self.delay, float) and not self.delay.is_integer():
            number(f"delay (for {self.interpolation})", self.delay, -0.999, LONGEST_DELAY)
            one_of("interpolation (for a delay in parts of a sample)", self.interpolation, PARTS)
        else:
            whole(f"delay (for {self.interpolation})", self.delay, LONGEST_DELAY, least)
        for name, other in (("input", "range"), ("output", "limit")):
            channel = getattr(self, name)
            right = "limit" if other == "range" else "range"
            given = channel.get(other) if isinstance(channel, Mapping) else getattr(channel, other, None)
            if given is not None:
                raise ValueError(f"{name} must have no {other}, but has {shown(given)}; use {right}")
            if isinstance(channel, Mapping):
                channel = _built(Channel, channel, name)
                object.__setattr__(self, name, channel)
            if not isinstance(channel, Channel):
                raise ValueError(f"{name} must be a Channel, but is {channel!r:.60}; use Channel('N', limit=20)")
        if self.output.lag is not None:
            raise ValueError(f"output must have no lag, but has {self.output.lag}; a lag is of the input")
        if self.input.lag is not None:
            one_of("interpolation (for an input with a lag)", self.interpolation, PARTS[:2])
        if self.input.kind != "displacement":
            raise ValueError(f"input must have no kind, but has {self.input.kind!r}; kind is of the output")
        if (told := kind_of(self.output.unit)) not in (None, self.output.kind):
            raise ValueError(
                f"output.kind must be {told!r} with the unit {self.output.unit}, but is {self.output.kind!r}; mend one"
            )
        object.__setattr__(self, "guess", _guessed(self.guess))

    @classmethod
    def silverbox(cls, interpolation: str = "spline", delay: int = 0) -> Rig:
        """The Silverbox record's, which ships: its input is band-limited. Online take ``linear`` or ``look_ahead``."""
        return replace(cls.shipped("silverbox"), interpolation=interpolation, delay=delay)

    @classmethod
    def shipped(cls, name: str) -> Rig:
        """A rig that comes with the package.

        Raises:
            ValueError: for another name.

        Example:
            >>> from estimator import Rig
            >>> Rig.shipped("beam").output.unit
            'mm'
        """
        one_of("name", name, SHIPPED)
        return _read_shipped(name)

    @classmethod
    def from_dict(cls, described: Mapping[str, Any]) -> Rig:
        """From nested dictionaries, as `to_dict` gives them, or a rig file holds them.

        Raises:
            ValueError: naming the key, for one that is unknown or missing, or a value out of its range.
        """
        return _built(cls, described, "rig")

    @classmethod
    def from_file(cls, path: str | Path) -> Rig:
        """Read a rig file, TOML: ``step``, ``interpolation``, ``delay``, tables ``input``, ``output`` and ``guess``.

        A table ``instrument`` is for who drives the rig (`with_instrument`).

        Raises:
            ValueError: naming the file and what is wrong in it.
            FileNotFoundError: if there is no such file.
        """
        return cls._read(path)[0]

    @classmethod
    def with_instrument(cls, rig: str) -> tuple[Rig, dict[str, Any]]:
        """A rig, as `of` has it, and the table ``instrument`` of its file; of a rig that ships, and of none, empty.

        Raises:
            ValueError: as `from_file`, or for an ``instrument`` that is no table.
            FileNotFoundError: if there is no such file.
        """
        return (cls.shipped(rig), {}) if rig in SHIPPED else cls._read(rig)

    @classmethod
    def _read(cls, path: str | Path) -> tuple[Rig, dict[str, Any]]:
        must = f"rig must be a file, a short TOML, or one of {', '.join(SHIPPED)}"
        place = whole_file(path, must, _LARGEST_FILE, "write it by hand, or by duffing-env rig init")
        text = ""
        try:
            text = place.read_text(encoding="utf-8-sig")
            described = tomllib.loads(text)
            instrument = described.pop("instrument", {})
            if not isinstance(instrument, dict):
                raise ValueError(f"instrument must be a table, but is {shown(instrument)}; write [instrument]")
            return cls.from_dict(described), instrument
        except (ValueError, RecursionError) as error:
            comma = " (a number has a point: 0.5, not 0,5)" if re.search(r"=\s*[-+]?\d+,\d", text) else ""
            raise ValueError(f"{place} must be a rig file, but is not: {error}{comma}") from error

    @classmethod
    def of(cls, rig: Rig | Mapping[str, Any] | str | Path) -> Rig:
        """A rig from whatever describes one: itself, a dictionary, the name of its file, or that of one that ships.

        Where a file has the name of a rig that ships, write ``./beam``.
        """
        if isinstance(rig, Rig):
            return rig
        if isinstance(rig, Mapping):
            return cls.from_dict(rig)
        if isinstance(rig, str | Path):
            return cls.shipped(rig) if isinstance(rig, str) and rig in SHIPPED else cls.from_file(rig)
        raise ValueError(f"rig must be a Rig, a dictionary or a file name, but is {rig!r:.60}; use Rig(step=...)")

    def save(self, path: str | Path) -> None:
        """Write a rig file, with comments, from which `from_file` gives the same rig; what was there is replaced.

        Raises:
            ValueError: for what is not the name of a file.
            OSError: where it cannot be written; what was there before still is.

        Example:
            >>> from estimator import Rig
            >>> rig = Rig(step=1e-3, guess={"m": (0.3, 0.5), "c": (0, 2), "a": (1e3, 5e3), "b": (0, 1e8)})
            >>> rig.save("rig.toml")
            >>> Rig.from_file("rig.toml") == rig
            True
        """
        from estimator.rig_text import text_of

        write_atomically(file_name("path", path), text_of(self))

    def to_dict(self) -> dict[str, Any]:
        """What JSON and TOML can hold, without what was left out."""
        described: dict[str, Any] = asdict(self)
        described["guess"] = None if self.guess is None else {name: list(ends) for name, ends in self.guess.items()}
        for name in ("input", "output"):
            described[name] = {key: value for key, value in described[name].items() if value is not None}
        return {key: value for key, value in described.items() if value is not None}

    @property
    def whole_delay(self) -> int:
        """The delay, for those that follow the input sample by sample.

        Raises:
            ValueError: for a delay in parts of a sample, or a lag of the input, which `identify` alone follows.
        """
        if self.input.lag is not None:
            raise ValueError(f"input must have no lag but for identify, but has {self.input.lag} s; leave it out")
        if self.delay != int(self.delay):
            raise ValueError(f"delay must be whole samples but for identify, but is {self.delay}; round it")
        return int(self.delay)

    @property
    def scales(self) -> Scales:
        """The input's limit and the output's range, 1 where they are not known, with step and units."""
        order = KINDS[self.output.kind]
        units = self.input.unit, self.output.unit
        return Scales(float(self.step), self.input.limit or 1.0, self.output.range or 1.0, order, *units)

    @property
    def model(self) -> Model:
        """Eq. (1) with offsets, as the rig's sensor shows it."""
        return duffing(offsets=True, sensor=self.output.kind)


@cache
def _read_shipped(name: str) -> Rig:
    return Rig.from_file(SHIPPED[name])


def _guessed(guess: object) -> dict[str, tuple[float, float]] | None:
    """Checked intervals; None where nothing is guessed."""
    if guess is None:
        return None
    if not isinstance(guess, Mapping) or set(guess) != set(_PARAMETERS):
        named = list(guess) if isinstance(guess, Mapping) else guess
        raise ValueError(f"guess must have intervals of {list(_PARAMETERS)}, but is of {named!r:.80}; or leave it out")
    checked = {}
    for name in _PARAMETERS:
        given = guess[name]
        ends = list(given) if isinstance(given, list | tuple | np.ndarray) else [given]
        if len(ends) != 2:
            raise ValueError(f"guess of {name} must be two numbers, low < high, but is {shown(given)}")
        least = SIZES[0] if name == "m" else -SIZES[1]
        for end in ends:
            number(f"guess of {name}", end, least, SIZES[1], "a mass is above 0" if name == "m" else "")
        if not ends[0] < ends[1]:
            raise ValueError(f"guess of {name} must be two numbers, low < high, but is {shown(given)}")
        checked[name] = (float(ends[0]), float(ends[1]))
    return checked


def _built(kind: Any, described: object, where: str) -> Any:
    """An object of a dataclass, from a dictionary of its arguments."""
    if not isinstance(described, Mapping):
        raise ValueError(f"{where} must be a table of names and values, but is {described!r:.60}")
    known = [one.name for one in fields(kind)]
    for key in described:
        if key not in known:
            raise ValueError(f"{where} must have keys of {known}, but has {key!r:.60}{hint(key, known)}")
    if kind is Rig and "step" not in described:
        raise ValueError("rig must have a step, but has none; give the seconds between samples")
    if kind is Rig:
        return kind(**described)
    try:
        return kind(**described)
    except ValueError as error:  # which begins with the name of a key
        key, _, rest = str(error).partition(" ")
        raise ValueError(f"{where}.{key} {rest.removeprefix(f'of an {where} ')}") from error
