"""`Rig`: an oscillator in the laboratory, with sampling step, units, limits, input interpolation, delay and guess."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from estimator.models.duffing import DERIVATIVE_ORDER_OF_SENSOR, PARAMETER_DIMENSIONS, duffing
from estimator.models.interpolation import INTERPOLATION_DEGREES
from estimator.models.model import Model
from estimator.rigs.channel import Channel
from estimator.rigs.rig_channels import check_keys, checked_inputs, checked_output
from estimator.rigs.rig_toml import rig_file_text
from estimator.rigs.units import MAGNITUDE_BOUNDS, Scales
from estimator.support.argument_checks import check_choice, check_integer, check_number, short_repr
from estimator.support.file_io import check_readable_file, to_path, write_atomically

#: Interpolations that allow a fractional delay.
FRACTIONAL_DELAY_INTERPOLATIONS = ("zero_order", "linear", "spline")

#: Largest delay [samples]: a larger one is a record that is not aligned.
MAX_DELAY = 1000

#: Largest rig file [bytes].
_MAX_FILE_BYTES = 2**20

#: Name of a rig that comes with the package, to its file.
SHIPPED_RIGS = {path.stem: path for path in sorted(Path(__file__).parent.glob("*.toml"), key=lambda p: p.stem)}

#: Parameters of a guess.
_GUESSED_PARAMETERS = tuple(PARAMETER_DIMENSIONS)


@dataclass(frozen=True)
class Rig:
    """An oscillator with its input and output channels, and a guess of its parameters. u and y are paired by index.

    Attributes:
        step: sampling step [s].
        interpolation: interpolation of the input of a differential equation; a difference equation has taps instead.
            ``zero_order``: u[k] acts from sample k to k + 1, so that its first effect is on y[k+1]; an accelerometer,
            too, measures y[k] just before the input changes to u[k]. ``linear``: from u[k-1] to u[k]. Both are causal,
            and the input before the first is 0. ``look_ahead``: the quintic spline through the last nine inputs and the
            next one, so that a sample is processed when the next input is known. ``spline``: the quintic spline through
            all inputs of a whole record. Before the first input, both splines are constant.
        delay: additional delay of the input [samples]. The newest tap of a difference equation acts on y[k] with
            u[k - delay]: 1 for the paper's in recorded data. -1 is for ``zero_order`` alone, with the pairs of an
            environment: u[k] acts before y[k]. `identify` takes fractional delays, above -1.
        input: the input channel; of several inputs a mapping from the model's names to their channels, in its order.
        output: the output channel.
        guess: parameter m, c, a, b to the central 90 % interval of its prior, in the units of the channels; any sign is
            possible, but m is positive. None: no guess.

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
    input: Channel | Mapping[str, Channel] = field(default_factory=Channel)
    output: Channel = field(default_factory=Channel)
    guess: Mapping[str, tuple[float, float]] | None = None

    def __post_init__(self) -> None:
        check_number("step", self.step, *MAGNITUDE_BOUNDS, "give the seconds between samples")
        check_choice("interpolation", self.interpolation, INTERPOLATION_DEGREES)
        least = -1 if self.interpolation == "zero_order" else 0
        if isinstance(self.delay, float) and not self.delay.is_integer():
            check_number(f"delay (for {self.interpolation})", self.delay, -0.999, MAX_DELAY)
            check_choice("interpolation (for a fractional delay)", self.interpolation, FRACTIONAL_DELAY_INTERPOLATIONS)
        else:
            check_integer(f"delay (for {self.interpolation})", self.delay, MAX_DELAY, least)
        object.__setattr__(self, "input", checked_inputs(self.input, self.interpolation))
        object.__setattr__(self, "output", checked_output(self.output))
        object.__setattr__(self, "guess", _check_guess(self.guess))
        if self.guess is not None and len(self.inputs) > 1:
            raise ValueError(f"guess must be left out with several inputs, {list(self.inputs)}; it is of one mass")

    @property
    def inputs(self) -> dict[str, Channel]:
        """The input channels by the names of the model's inputs; one that has no name is ``u``."""
        return {"u": self.input} if isinstance(self.input, Channel) else dict(self.input)

    @property
    def only_input(self) -> Channel:
        """The channel of the only input.

        Raises:
            ValueError: for several inputs.
        """
        if len(self.inputs) > 1:
            raise ValueError(
                f"rig must have one input here, but has {list(self.inputs)}; OnlineEstimator and "
                f"maximum_a_posteriori take several"
            )
        return next(iter(self.inputs.values()))

    def check_inputs_of(self, model: Model) -> None:
        """Refuse a model with other inputs. One channel without a name is of any model with one input or none.

        Raises:
            ValueError: naming the inputs.
        """
        if isinstance(self.input, Channel) and model.n_inputs <= 1:
            return
        if isinstance(self.input, Channel) or list(self.input) != list(model.inputs):
            channels = ", ".join(f"{name!r}: Channel(...)" for name in model.inputs)
            raise ValueError(
                f"rig.input must have a channel for each input of {model.name!r}, in its order {list(model.inputs)}, "
                f"but has {list(self.inputs)}; write input={{{channels}}}"
            )

    @classmethod
    def of_scales(cls, model: Model, scales: Scales) -> Rig:
        """The rig in the units of a model's scales: a linear input, or a delay of 1 for a difference equation."""
        units = scales.input_units(model.n_inputs)
        by_name = {name: Channel(unit) for name, unit in zip(model.inputs, units, strict=True)}
        inputs = Channel(scales.input_unit) if len(by_name) <= 1 else by_name
        timing: tuple[str, int] = ("linear", 0) if model.is_continuous else ("zero_order", 1)
        return cls(scales.step, *timing, inputs, Channel(scales.output_unit))

    @classmethod
    def silverbox(cls, interpolation: str = "spline", delay: int = 0) -> Rig:
        """The rig of the Silverbox record, with a band-limited input. Online use ``linear`` or ``look_ahead``."""
        return replace(cls.shipped("silverbox"), interpolation=interpolation, delay=delay)

    @classmethod
    def shipped(cls, name: str) -> Rig:
        """A rig that comes with the package, by its name.

        Raises:
            ValueError: for an unknown name.

        Example:
            >>> from estimator import Rig
            >>> Rig.shipped("beam").output.unit
            'mm'
        """
        check_choice("name", name, SHIPPED_RIGS)
        return _read_shipped(name)

    @classmethod
    def from_dict(cls, mapping: Mapping[str, Any]) -> Rig:
        """A rig from nested dictionaries, such as of `to_dict` or a rig file.

        Raises:
            ValueError: naming the key, for an unknown or missing key, or a value out of its range.
        """
        check_keys(cls, mapping, "rig")
        if "step" not in mapping:
            raise ValueError("rig must have a step, but has none; give the seconds between samples")
        return cls(**mapping)

    @classmethod
    def from_file(cls, path: str | Path) -> Rig:
        """Read a TOML rig file: ``step``, ``interpolation``, ``delay``, tables ``input``, ``output`` and ``guess``.

        Several inputs have a table each by their names, ``input.left`` and ``input.right``. A table ``instrument``
        holds settings of the plant (`read_with_instrument`).

        Raises:
            ValueError: naming the file and the fault.
            FileNotFoundError: for a file that does not exist.
        """
        return cls._read(path)[0]

    @classmethod
    def read_with_instrument(cls, rig: str) -> tuple[Rig, dict[str, Any]]:
        """A rig by name or file, and the table ``instrument`` of its file; an empty table where there is none.

        Raises:
            ValueError: as `from_file`, or for an ``instrument`` that is no table.
            FileNotFoundError: for a file that does not exist.
        """
        return (cls.shipped(rig), {}) if rig in SHIPPED_RIGS else cls._read(rig)

    @classmethod
    def _read(cls, path: str | Path) -> tuple[Rig, dict[str, Any]]:
        must = f"rig must be a file, a short TOML, or one of {', '.join(SHIPPED_RIGS)}"
        place = check_readable_file(path, must, _MAX_FILE_BYTES, "write it by hand, or by duffing-env rig init")
        text = ""
        try:
            text = place.read_text(encoding="utf-8-sig")
            mapping = tomllib.loads(text)
            instrument = mapping.pop("instrument", {})
            if not isinstance(instrument, dict):
                raise ValueError(f"instrument must be a table, but is {short_repr(instrument)}; write [instrument]")
            return cls.from_dict(mapping), instrument
        except (ValueError, RecursionError) as error:
            comma = " (a number has a point: 0.5, not 0,5)" if re.search(r"=\s*[-+]?\d+,\d", text) else ""
            raise ValueError(f"{place} must be a rig file, but is not: {error}{comma}") from error

    @classmethod
    def from_any(cls, rig: Rig | Mapping[str, Any] | str | Path) -> Rig:
        """A rig from a rig, a dictionary, the name of a file, or the name of a rig that comes with the package.

        For a file with the name of a rig of the package, write ``./beam``.

        Raises:
            ValueError: for anything else, or as `from_dict` and `from_file`.
        """
        if isinstance(rig, Rig):
            return rig
        if isinstance(rig, Mapping):
            return cls.from_dict(rig)
        if isinstance(rig, str | Path):
            return cls.shipped(rig) if isinstance(rig, str) and rig in SHIPPED_RIGS else cls.from_file(rig)
        raise ValueError(f"rig must be a Rig, a dictionary or a file name, but is {rig!r:.60}; use Rig(step=...)")

    def save(self, path: str | Path) -> None:
        """Write a rig file with comments, from which `from_file` reads the same rig; an existing file is replaced.

        Raises:
            ValueError: for a path that is no name of a file.
            OSError: where it cannot be written; an existing file stays as it was.

        Example:
            >>> from estimator import Rig
            >>> rig = Rig(step=1e-3, guess={"m": (0.3, 0.5), "c": (0, 2), "a": (1e3, 5e3), "b": (0, 1e8)})
            >>> rig.save("rig.toml")
            >>> Rig.from_file("rig.toml") == rig
            True
        """
        write_atomically(to_path("path", path), self.to_toml())

    def to_toml(self, provenance: str = "") -> str:
        """The text of a rig file, with comments; an unknown value is a comment to fill in.

        Args:
            provenance: source of the numbers, for the first line, such as ``", from record.csv"``.
        """
        scales, dimensions = self.scales, duffing(offsets=True).dimensions
        units = {name: scales.unit(dimensions[name]) for name in _GUESSED_PARAMETERS if len(self.inputs) == 1}
        return rig_file_text(
            self.step, self.interpolation, self.delay, self.input, self.output, self.guess, units, provenance
        )

    def to_dict(self) -> dict[str, Any]:
        """The rig as nested dictionaries for JSON and TOML, without unknown values."""
        mapping: dict[str, Any] = asdict(self)
        mapping["guess"] = None if self.guess is None else {name: list(ends) for name, ends in self.guess.items()}
        return {key: _without_none(value) for key, value in mapping.items() if value is not None}

    @property
    def integer_delay(self) -> int:
        """The delay [samples], for estimators and plants that take the input sample by sample.

        Raises:
            ValueError: for a fractional delay, or a lag of the input, which `identify` alone takes.
        """
        for channel in self.inputs.values():
            if channel.lag is not None:
                raise ValueError(f"input must have no lag, except for identify, but has {channel.lag} s; leave it out")
        if self.delay != int(self.delay):
            raise ValueError(f"delay must be an integer, except for identify, but is {self.delay}; round it")
        return int(self.delay)

    @property
    def scales(self) -> Scales:
        """The scales: the inputs' limits and the output's range, 1 where unknown, with step and units."""
        order = DERIVATIVE_ORDER_OF_SENSOR[self.output.kind]
        (limit, unit), *others = ((one.limit or 1.0, one.unit) for one in self.inputs.values())
        return Scales(
            float(self.step), limit, self.output.range or 1.0, order, unit, self.output.unit,
            tuple(limit for limit, _ in others), tuple(unit for _, unit in others),
        )  # fmt: skip

    @property
    def model(self) -> Model:
        """Eq. (1) with offsets, and with the output of the rig's sensor.

        Raises:
            ValueError: for several inputs.
        """
        if len(self.inputs) > 1:
            raise ValueError(f"model must be given for a rig with several inputs, {list(self.inputs)}; make a Model")
        return duffing(offsets=True, sensor=self.output.kind)


@cache
def _read_shipped(name: str) -> Rig:
    return Rig.from_file(SHIPPED_RIGS[name])


def _check_guess(guess: object) -> dict[str, tuple[float, float]] | None:
    """The checked intervals of a guess; None without a guess."""
    if guess is None:
        return None
    if not isinstance(guess, Mapping) or set(guess) != set(_GUESSED_PARAMETERS):
        named = list(guess) if isinstance(guess, Mapping) else guess
        raise ValueError(
            f"guess must have intervals of {list(_GUESSED_PARAMETERS)}, but is of {named!r:.80}; or leave it out"
        )
    checked = {}
    for name in _GUESSED_PARAMETERS:
        given = guess[name]
        ends = list(given) if isinstance(given, list | tuple | np.ndarray) else [given]
        if len(ends) != 2:
            raise ValueError(f"guess of {name} must be two numbers, low < high, but is {short_repr(given)}")
        least = MAGNITUDE_BOUNDS[0] if name == "m" else -MAGNITUDE_BOUNDS[1]
        for end in ends:
            check_number(
                f"guess of {name}", end, least, MAGNITUDE_BOUNDS[1], "a mass is above 0" if name == "m" else ""
            )
        if not ends[0] < ends[1]:
            raise ValueError(f"guess of {name} must be two numbers, low < high, but is {short_repr(given)}")
        checked[name] = (float(ends[0]), float(ends[1]))
    return checked


def _without_none(value: Any) -> Any:
    """A value of `Rig.to_dict` without unknown values, however deep."""
    if not isinstance(value, dict):
        return value
    return {key: _without_none(inner) for key, inner in value.items() if inner is not None}
