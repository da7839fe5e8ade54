"""`Model`: one equation of a plant, from which all compiled code is derived.

A model is a declaration. From it `estimator.engine` derives the simulated plant, the filter, the Fisher information,
the predictions of a planner and the gradients of an oracle.
"""

from __future__ import annotations

import hashlib
import json
import keyword
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields
from functools import cached_property

from estimator.models.expression import FUNCTIONS, input_derivative, names_in, names_in_expression, older_input, parse
from estimator.models.finite_slopes import check_slopes
from estimator.support.argument_checks import (
    check_bool,
    check_choice,
    check_integer,
    check_mapping,
    check_number,
    short_repr,
)

#: Names of inputs, states, coefficients and sensors; names with capital letters belong to the engine.
_NAME_PATTERN = re.compile(r"[a-z][a-z0-9_]*")

#: Highest power in an expression; integer powers are computed as products.
MAX_POWER = 16

#: Names with another meaning: the sampling step, the number pi, functions, and what generated code uses.
RESERVED_NAMES = frozenset({"step", "pi", *FUNCTIONS, "capped", "range"})


#: The inputs of a model that names none.
DEFAULT_INPUTS = {"u": ""}

#: Largest number of samples by which an input of a difference equation may be older than the newest.
MAX_INPUT_AGE = 2

#: Fields that came later, with the values at which they are left out of the digest: oracles are named by it.
_LATER_FIELDS: dict[str, object] = {
    "inputs": DEFAULT_INPUTS, "constants": {}, "time": "sample", "independent_noise": False, "initial_states": {},
}  # fmt: skip


@dataclass(frozen=True, eq=False)
class Model:
    """The equation of a plant with unknown coefficients.

    A model has either ``rates`` (a differential equation) or ``next_state`` (a difference equation). All expressions
    are strings in the names of states, coefficients, inputs and constants and ``pi``, with ``sin``, ``cos``, ``tanh``,
    ``atan``, ``exp``, ``log``, ``sqrt``, ``abs``, ``sign``, ``min``, ``max`` and ``where(condition, a, b)``, whose
    condition compares two expressions by ``<``, ``<=``, ``>`` or ``>=``. At a jump or a kink a derivative is taken from
    one side; of ``sign`` it is 0, and of ``abs`` at 0 it is 0. In a difference equation the input ``u`` is its newest
    value, which acts on the next state, and ``u[-1]`` and ``u[-2]`` are its values one and two samples before. In a
    differential equation ``derivative(u)`` is its time derivative, where an interpolation makes it continuous.

    Attributes:
        name: name of the model, for messages and generated files.
        states: state to unit.
        coefficients: coefficient to unit; all are unknown and constant, or drift slowly where an estimator assumes it.
        noise: per state, the effect of process noise of unit strength: for rates, the root of its white intensity, or a
            force that is constant over a sample where ``held``; for a next state, the added noise. One source drives
            all states, or with ``independent_noise`` each has its own.
        outputs: sensor to its measured quantity, without sensor noise; at least one. The strength of the process noise
            is its effect on the first sensor within one sample.
        inputs: input to unit, in the order of arrays and actions; ``{}`` has none. The default is one input, ``u``.
        rates: time derivatives of the states.
        next_state: the states one sample later.
        held: whether the process noise of a differential equation is held over each sample, and not white.
        substeps: Runge-Kutta steps of order 4 per sample, enough that the integration error stays below a tenth of the
            standard deviation after a long record.
        physical: parameter of the plant to its expression in coefficients and the sampling ``step`` [s]; may be empty.
        dimensions: parameter to its powers of the input's unit, the displacement's unit and the second, for scaled
            coefficients; or to its unit, where ``physical`` gives the numbers in it.
        inverse: coefficient to its expression in the parameters and ``step``; all of them, where ``physical`` is given.
        constants: name of a number to its value, such as ``{"g": 9.81}``; all expressions may use them.
        time: unit of time in rates and noise: ``sample``; or ``s``, where all numbers are in the stated units, and the
            noise is the root of a white intensity per second. `estimator.rigs.stated_units` makes a prior and a scaled
            model of it.
        independent_noise: whether each state has process noise of its own, independent of the others'. The expressions
            in ``noise`` are then the ratios of the strengths, which one unknown factor scales
            (`estimator.models.noise_ratios.scale_noise_sources` changes them).
        initial_states: state to the coefficient that is its unknown value before the first sample; the others begin
            near rest. Such a coefficient may occur in no expression.

    Raises:
        ValueError: naming the argument, for a name that is not a lower-case identifier or occurs twice, expressions
            with unknown names or a slope that is not finite where a root or a power is 0
            (`estimator.models.finite_slopes.check_slopes`), a coefficient without effect, or an output that depends on
            no state or coefficient.

    Example:
        >>> from estimator.models.model import Model
        >>> decay = Model("decay", {"x": "V"}, {"rate": "1"}, noise=("1",), outputs={"y": "x"}, rates=("u - rate*x",))
        >>> decay.n_states, decay.n_coefficients, decay.is_continuous
        (1, 1, True)
    """

    name: str
    states: Mapping[str, str]
    coefficients: Mapping[str, str]
    noise: tuple[str, ...]
    outputs: Mapping[str, str]
    inputs: Mapping[str, str] = field(default_factory=DEFAULT_INPUTS.copy)
    rates: tuple[str, ...] = ()
    next_state: tuple[str, ...] = ()
    held: bool = False
    substeps: int = 1
    physical: Mapping[str, str] = field(default_factory=dict)
    dimensions: Mapping[str, tuple[int, int, int] | str] = field(default_factory=dict)
    inverse: Mapping[str, str] = field(default_factory=dict)
    constants: Mapping[str, float] = field(default_factory=dict)
    time: str = "sample"
    independent_noise: bool = False
    initial_states: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for field_name in ("states", "coefficients", "outputs", "inputs", "physical", "inverse", "initial_states"):
            check_mapping(field_name, getattr(self, field_name), str)
        check_mapping("dimensions", self.dimensions, Sequence)
        check_choice("time", self.time, ("sample", "s"))
        if self.time == "s" and self.next_state:
            raise ValueError("time must be 'sample' for a difference equation, but is 's'; leave it out")
        check_mapping("constants", self.constants)
        for constant, value in self.constants.items():
            check_number(f"constants[{constant!r}]", value, -1e30, 1e30)
        for field_name in ("noise", "rates", "next_state"):
            texts = getattr(self, field_name)
            if isinstance(texts, list):  # from JSON
                texts = tuple(texts)
                object.__setattr__(self, field_name, texts)
            if not isinstance(texts, tuple) or not all(isinstance(text, str) for text in texts):
                raise ValueError(
                    f"{field_name} must be a tuple of expressions, but is {short_repr(texts)}; ('1',) has one"
                )
        if not isinstance(self.name, str):
            raise ValueError(f"name must be a text, but is {short_repr(self.name)}")
        check_bool("held", self.held)
        check_bool("independent_noise", self.independent_noise)
        check_integer("substeps", self.substeps, 10_000)
        for field_name, powers in self.dimensions.items():
            if isinstance(powers, str):
                continue
            if self.time == "s":
                raise ValueError(
                    f"dimensions of {field_name} must be a unit such as 'kg' where time is in seconds, but are "
                    f"{short_repr(powers)}"
                )
            if len(powers) != 3 or not all(type(power) is int and abs(power) < 100 for power in powers):
                raise ValueError(
                    f"dimensions of {field_name} must be three whole numbers, but are {short_repr(powers)}"
                )
        names = [*self.states, *self.coefficients, *self.outputs, *self.inputs, *self.constants]
        for name in (self.name, *names):
            if not _NAME_PATTERN.fullmatch(name) or keyword.iskeyword(name) or name in RESERVED_NAMES:
                raise ValueError(
                    f"names must be lower-case identifiers, none of {sorted(RESERVED_NAMES)}, but one is {name!r}; "
                    f"rename it"
                )
        repeated = sorted({name for name in names if names.count(name) > 1})
        if repeated:
            raise ValueError(
                f"states, coefficients, outputs, inputs and constants must have different names, but share {repeated}; "
                f"rename one"
            )
        # With x, x_a, a_b and b, the pairs (x, a_b) and (x_a, b) would share the covariance P_x_a_b.
        joined_names = [f"{i}_{j}" for i in self.names for j in self.names]
        shared = sorted({pair for pair in joined_names if joined_names.count(pair) > 1})
        if shared:
            raise ValueError(f"pairs of names must differ when joined by '_', but {shared} occur twice; rename one")
        if bool(self.rates) == bool(self.next_state):
            raise ValueError("either rates or next_state must be given; rates for a differential equation")
        for field_name, values in (
            ("rates" if self.rates else "next_state", self.update_expressions),
            ("noise", self.noise),
        ):
            if len(values) != len(self.states):
                raise ValueError(
                    f"{field_name} must have one expression per state, {len(self.states)}, but has {len(values)}"
                )
        if not self.states or not self.outputs:
            raise ValueError("states and outputs must name at least one each, but one of them is empty")
        if self.held and not self.is_continuous:
            raise ValueError("held must be False for a difference equation, whose noise acts once per sample")
        if set(self.dimensions) != set(self.physical):
            raise ValueError(f"dimensions must be of {list(self.physical)}, but are of {list(self.dimensions)}")
        if bool(self.physical) != bool(self.inverse) or (self.inverse and set(self.inverse) != set(self.coefficients)):
            raise ValueError(
                f"physical and inverse go together, and inverse must give {list(self.coefficients)}, but gives "
                f"{list(self.inverse)}"
            )
        for state, coefficient in self.initial_states.items():
            if state not in self.states or coefficient not in self.coefficients:
                raise ValueError(
                    f"initial_states must give a state of {list(self.states)} a coefficient of "
                    f"{list(self.coefficients)}, but has {state!r}: {coefficient!r}"
                )
        self._validate_expressions()
        # In the order of the names, whatever the order in which they are written.
        object.__setattr__(self, "dimensions", {name: self.dimensions[name] for name in self.physical})
        by_state = {name: self.initial_states[name] for name in self.states if name in self.initial_states}
        object.__setattr__(self, "initial_states", by_state)
        if self.inverse:
            object.__setattr__(self, "inverse", {name: self.inverse[name] for name in self.coefficients})

    def _validate_expressions(self) -> None:
        """Refuse expressions with unknown names, coefficients without effect, and outputs without a state."""
        inputs = (*self.input_ages, *(input_derivative(name) for name in self.inputs if self.is_continuous))
        for texts, mapped in ((self.physical, self.coefficients), (self.inverse, self.physical)):
            for text in texts.values():
                names_in_expression(text, (*mapped, *self.constants, "step"), self.name)
        known = (*self.names, *self.constants, *inputs)
        output_names = [names_in_expression(text, known, self.name) for text in self.outputs.values()]
        for sensor, names in zip(self.outputs, output_names, strict=True):
            if names.isdisjoint(self.names):
                raise ValueError(f"outputs must show a state or a coefficient each, but {sensor!r} shows none")
        motion_names = [names_in_expression(text, known, self.name) for text in self.update_expressions]
        noise_names = [names_in_expression(text, (*self.names, *self.constants), self.name) for text in self.noise]
        used_at_start = set(self.initial_states.values())
        unused = sorted(set(self.coefficients).difference(used_at_start, *output_names, *motion_names, *noise_names))
        if unused:
            raise ValueError(
                f"coefficients must stand in an expression, but {unused} do not; use them, or leave them out"
            )
        for text in (*self.update_expressions, *self.outputs.values(), *self.noise):
            check_slopes(text, (*self.states, *inputs), self.constants, self.name)

    def _names_in(self, texts: Iterable[str]) -> set[str]:
        """The names in expressions that are checked."""
        return set().union(*(names_in(parse(text, self.name)) for text in texts))

    @property
    def is_continuous(self) -> bool:
        """Whether the model is a differential equation."""
        return bool(self.rates)

    @property
    def update_expressions(self) -> tuple[str, ...]:
        """Expressions of the rates or of the next state."""
        return self.rates or self.next_state

    @property
    def n_states(self) -> int:
        """Number of states n."""
        return len(self.states)

    @property
    def n_coefficients(self) -> int:
        """Number of coefficients K."""
        return len(self.coefficients)

    @property
    def n_outputs(self) -> int:
        """Number of sensors."""
        return len(self.outputs)

    @property
    def names(self) -> tuple[str, ...]:
        """States, then coefficients: the order of joint means and covariances."""
        return (*self.states, *self.coefficients)

    @property
    def n_inputs(self) -> int:
        """Number of inputs."""
        return len(self.inputs)

    @property
    def input_ages(self) -> dict[str, tuple[str, int]]:
        """Name of an input's value in expressions, to the input and its age [samples]; the newest has the age 0."""
        ages = range(1 if self.is_continuous else MAX_INPUT_AGE + 1)
        return {older_input(name, age): (name, age) for name in self.inputs for age in ages}

    @cached_property
    def acting_inputs(self) -> dict[str, tuple[str, int]]:
        """Inputs and their derivatives in a differential equation: name in expressions to the input and its order.

        The inputs themselves have the order 0; the time derivatives that expressions contain have the order 1.
        """
        used = self._names_in((*self.update_expressions, *self.outputs.values()))
        derivatives = {input_derivative(name): (name, 1) for name in self.inputs if input_derivative(name) in used}
        return {name: (name, 0) for name in self.inputs} | derivatives

    @cached_property
    def taps(self) -> dict[str, int]:
        """Number of values of each input in a difference equation: 1, or 2 or 3 where it contains older ones."""
        used = self._names_in((*self.update_expressions, *self.outputs.values()))
        oldest = dict.fromkeys(self.inputs, 0)
        for written, (name, age) in self.input_ages.items():
            oldest[name] = max(oldest[name], age if written in used else 0)
        return {name: age + 1 for name, age in oldest.items()}

    @cached_property
    def dynamic_names(self) -> tuple[str, ...]:
        """The states and the coefficients that the motion depends on, without coefficients of sensors alone."""
        used = self._names_in(self.update_expressions)
        return (*self.states, *(name for name in self.coefficients if name in used))

    @cached_property
    def noise_sources(self) -> tuple[str, ...]:
        """The states with process noise of their own; empty where one source drives all states."""
        pairs = zip(self.states, self.noise, strict=True)
        return tuple(state for state, text in pairs if text.strip() != "0") if self.independent_noise else ()

    @cached_property
    def initial_state_coefficients(self) -> tuple[tuple[int, int], ...]:
        """Places (state, coefficient) of ``initial_states``."""
        states, coefficients = list(self.states), list(self.coefficients)
        return tuple((states.index(state), coefficients.index(c)) for state, c in self.initial_states.items())

    def _described_fields(self) -> dict[str, object]:
        """The fields by name, without cached properties, and without later additions at their defaults.

        So neither the digest nor a file of a model that does not use them changes.
        """
        values = {one.name: getattr(self, one.name) for one in fields(self)}
        return {key: value for key, value in values.items() if key not in _LATER_FIELDS or value != _LATER_FIELDS[key]}

    @cached_property
    def digest(self) -> str:
        """Twelve hexadecimal digits that identify the model."""
        values = self._described_fields()
        text = json.dumps({key: dict(v) if isinstance(v, Mapping) else v for key, v in values.items()})
        return hashlib.sha256(text.encode()).hexdigest()[:12]

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Model) and self.digest == other.digest

    def __hash__(self) -> int:
        return hash(self.digest)

    @classmethod
    def require_model(cls, value: object) -> Model:
        """The value itself, which must be a model.

        Raises:
            ValueError: for another object.
        """
        if not isinstance(value, cls):
            raise ValueError(f"model must be a Model, but is {short_repr(value)}; use difference() or duffing()")
        return value

    def to_dict(self) -> dict[str, object]:
        """The declaration for JSON; ``Model(**d)`` makes the same model again."""
        kept = self._described_fields()
        return {key: list(v) if isinstance(v, tuple) else v for key, v in asdict(self).items() if key in kept}
