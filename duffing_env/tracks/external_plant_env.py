"""An environment around a real plant on a rig: an object that takes inputs and gives outputs in the rig's units."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar, Protocol, SupportsFloat
from weakref import WeakValueDictionary

import numpy as np
import numpy.typing as npt
from gymnasium import logger
from gymnasium.error import ResetNeeded

from duffing_env.env import DuffingEnv, Observation
from duffing_env.experiment_config import MAX_SAMPLES, Experiment
from duffing_env.input_options import ByInput
from duffing_env.prior_checks import check_prior
from duffing_env.rewards.named_rewards import kernel_reward
from estimator.belief import Belief
from estimator.inference.noise_grid import NoiseGridSize
from estimator.models.model import Model
from estimator.models.named_parameters import Parameters
from estimator.rigs.channel import Channel
from estimator.rigs.rig import Rig
from estimator.rigs.rig_prior import equal_effect_log_ratio, reset_state, rig_prior
from estimator.rigs.units import Scales
from estimator.support.argument_checks import check_integer, short_repr
from estimator.support.array_types import FloatArray

RigLike = Rig | Mapping[str, Any] | str | Path

#: Remedy for several environments around one plant, or several plants in one environment.
ONE_PLANT_MESSAGE = (
    "one plant is one environment; for several use "
    "gymnasium.vector.SyncVectorEnv([lambda: gym.make('duffing_env/Rig-v0', rig=rig, plant=plant_1), ...])"
)


class Plant(Protocol):
    """The methods of a plant: of a simulator, a circuit behind a converter, or a process behind a socket."""

    def reset(self) -> object:
        """Bring the plant to rest, without input; the returned object is ignored."""

    def step(self, u: Any) -> SupportsFloat | npt.NDArray[Any]:
        """Apply the input u for one sampling step, and return the output at its end, both in the rig's units.

        The input is a float, or an array (inputs,) of several inputs. The output is one number, or an array that holds
        one.
        """
        ...


def playable_rig(rig: RigLike | None, needs_guess: bool = True) -> Rig:
    """The rig of an environment, checked.

    The interpolations ``look_ahead`` and ``spline`` depend on later inputs: in an environment the input goes linearly
    from one sample to the next instead.

    Raises:
        ValueError: for no rig; for a rig without limit, range or guess; for a rig with a delay; and where the motion is
            guessed by a sensor whose offset exceeds half of its range.
    """
    if rig is None:
        raise ValueError("rig must be a Rig, a dictionary or a file name, but is None; pass rig='rig.toml'")
    rig = Rig.from_any(rig)
    several = not isinstance(rig.input, Channel)
    needed: dict[str, object] = {
        f"input.{name}.limit" if several else "input.limit": one.limit for name, one in rig.inputs.items()
    }
    needed |= {"output.range": rig.output.range, "guess": rig.guess}
    for name, given in needed.items():
        if given is None and (needs_guess or name != "guess"):
            raise ValueError(f"rig must have {name} to be played, but has none; add it to the rig")
    if rig.delay > 0:
        raise ValueError(
            f"rig must have no delay for an environment, but has {rig.delay}; the plant waits for its input"
        )
    sensor = rig.output
    assert sensor.range is not None
    if needs_guess and sensor.kind == "displacement" and abs(sensor.offset) > sensor.range / 2:
        raise ValueError(
            f"output.offset must be within half of the range, by which the motion is guessed, but is {sensor.offset:g} "
            f"of {sensor.range:g} {sensor.unit}; subtract it from the output, and give the range of the motion"
        )
    return rig


class RigScaling:
    """The limits, units and sampling step of experiments on a rig."""

    rig: RigLike | None
    max_input: ByInput
    max_output: float

    #: The guess makes a wide prior.
    uses_cubature: ClassVar[bool] = True

    def _check_fractions(self) -> None:
        for name in ("max_input", "max_output"):
            value = getattr(self, name)
            if max(value.values() if isinstance(value, Mapping) else [value]) > 1:
                raise ValueError(f"{name} must be at most 1, the rig's own limit, but is {value!r}")

    @property
    def validated_rig(self) -> Rig:
        """The option ``rig``, once it is checked."""
        assert isinstance(self.rig, Rig)
        return self.rig

    @property
    def degree(self) -> int:
        """Degree of the input over a sample: 0 held, 1 linear from the last input on."""
        return int(self.validated_rig.interpolation != "zero_order")

    @property
    def step(self) -> float:
        """The rig's sampling step [s]."""
        return float(self.validated_rig.step)

    @property
    def scales(self) -> Scales:
        """The rig's factors from internal to physical units."""
        return self.validated_rig.scales


@dataclass(frozen=True)
class RigPlantExperiment(RigScaling, Experiment):
    """An experiment on a rig's real plant, whose parameters are unknown.

    `duffing_env.tracks.rig_env.RigEnv` describes its options. Seven values of each noise span three decades.

    Attributes:
        prior: the belief that every episode starts from, in the rig's scales; None: the prior from the rig's guess.
            With a prior the rig needs no guess. The state of the prior is replaced by rest.
    """

    rig: RigLike | None = None
    max_input: ByInput = 1.0
    max_output: float = 1.0
    horizon: int = 256
    prior: Belief | None = None
    noise_hypotheses: NoiseGridSize = (7, 7)

    knows_truth: ClassVar[bool] = False

    def __post_init__(self) -> None:
        object.__setattr__(self, "rig", playable_rig(self.rig, self.prior is None))
        if self.prior is not None:
            check_prior(self.prior, self.scales)
            self.validated_rig.check_inputs_of(self.prior.model)
        # A posterior has the state at the end of its record, but the plant is brought to rest.
        prior = rig_prior(self.validated_rig) if self.prior is None else reset_state(self.prior)
        object.__setattr__(self, "prior", prior)
        super().__post_init__()
        self._check_fractions()
        check_integer("horizon", self.horizon, MAX_SAMPLES)
        if kernel_reward(self.reward).needs_truth:
            raise ValueError(
                f"reward must not be {self.reward!r} for a real plant, whose true parameters are unknown; use "
                "'information_gain', 'expected_free_energy' or 'free_energy'"
            )
        if self.observation == "privileged":
            raise ValueError(
                "observation must not be 'privileged' for a real plant, whose true parameters are unknown; use "
                "'posterior' or 'history'"
            )
        if self.model.n_outputs != 1:
            raise ValueError(
                f"prior must be of a model with one sensor, but {self.model.name!r} has {self.model.n_outputs}; "
                "a plant gives one number"
            )

    @property
    def samples(self) -> int:
        """The horizon."""
        return self.horizon

    @property
    def likeliest_log_noise_ratio(self) -> float | None:
        """The noise ratio of the prior, where both noises are unknown independently."""
        return equal_effect_log_ratio(self.prior_belief) if isinstance(self.noise_hypotheses, tuple) else None

    @property
    def model(self) -> Model:
        """The model of the prior."""
        return self.prior_belief.model

    @property
    def nominal_parameters(self) -> dict[str, float]:
        """The means of the prior, in internal units, in place of the unknown true parameters."""
        dimensions = self.model.dimensions
        parameters = self.prior_belief.parameters()
        return {
            name: mean / self.scales.factor(dimensions.get(name, (0, 0, 0))) for name, (mean, *_) in parameters.items()
        }

    @cached_property
    def prior_belief(self) -> Belief:
        """The option ``prior``, or the prior from the rig's guess."""
        assert self.prior is not None
        return self.prior


class RigPlantEnv(DuffingEnv):
    r"""An environment around a rig's real plant: ``Rig-v0`` with ``plant=``.

    Plant and estimator get the same input: the action in float32, clipped to [-1, 1], times ``max_input`` and the rig's
    limit. The plant's ``step`` keeps the time: it returns when the sample is measured. The environment applies nothing
    between two calls of its ``step``, and nothing after the end of an episode until ``reset``, so the plant's ``reset``
    must switch the input off. The compiled step is ready before the first call of the plant. With ``hold`` the plant's
    ``step`` is called for every sample, with the same input.

    Rewards that need the truth are refused, because the true parameters are unknown: the info has no
    ``log_posterior_gain``, and ``env.unwrapped.truth`` raises AttributeError. If the plant raises an exception or
    returns no finite number, the episode ends (``info["diverged"]``), and the belief stays as it was before that step.
    After an exception, or a return value that is no number at all, there is also a warning, and
    ``env.unwrapped.plant_error`` holds the exception's type and message until the next reset; otherwise it is None,
    also after NaN. An exception in ``plant.reset()`` propagates from ``reset``, and no episode has begun.

    A plant and a prior are Python objects, so JSON cannot hold the specification of an environment made with them. An
    environment is copied and pickled with its plant, if the plant can be. A plant belongs to the environment that reset
    it last: ``step`` of another environment around it raises ``ResetNeeded``, and the plant gets no input.

    Args:
        plant: the plant, which the caller closes.
        render_mode: as `DuffingEnv`.
        options: fields of `RigPlantExperiment`.
    """

    experiment_class: ClassVar[type[Experiment]] = RigPlantExperiment
    _reset_options: ClassVar[tuple[str, ...]] = ()
    _info_gains: ClassVar[tuple[str, ...]] = ("information_gain",)

    #: Identity of a plant to the environment that reset it last.
    _last_env_of_plant: ClassVar[WeakValueDictionary[int, RigPlantEnv]] = WeakValueDictionary()

    def __init__(self, plant: Plant, *, render_mode: str | None = None, **options: Any) -> None:
        if isinstance(plant, type):
            name = plant.__name__
            raise ValueError(f"plant must be an object with reset and step, but is the class {name}; pass {name}()")
        for method in ("reset", "step"):
            if not callable(getattr(plant, method, None)):
                raise ValueError(f"plant must have methods reset() and step(u), but {plant!r} has no {method}()")
        super().__init__(render_mode=render_mode, **options)
        self.plant = plant
        self.plant_error: str | None = None
        # Compile now: a plant would otherwise keep its first input on while the compiler runs.
        self._batch.step(0.0)

    @property
    def truth(self) -> Parameters:
        """The plant's true parameters are unknown.

        Raises:
            AttributeError: always.
        """
        raise AttributeError("the true parameters of a real plant are unknown; use env.unwrapped.belief")

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Bring the plant to rest and start an episode; ``options`` has no keys, and the plant gets no seed."""
        return super().reset(seed=seed, options=options)

    def _reset_plant(self) -> None:
        self._running, self.plant_error = False, None
        self._last_env_of_plant[id(self.plant)] = self
        self.plant.reset()

    def _apply_sample(self, action: float | FloatArray) -> None:
        if self._last_env_of_plant.get(id(self.plant), self) is not self:
            raise ResetNeeded(
                f"plant must not be shared, but another environment has reset it meanwhile: {ONE_PLANT_MESSAGE}"
            )
        scales = self.experiment.scales
        u = self.experiment.max_inputs * np.float32(action).astype(np.float64)
        given = scales.input_scales(len(u)) * u
        try:
            y = as_number("step", self.plant.step(given.item() if len(given) == 1 else given)) / scales.output
        except Exception as error:  # any error ends the episode in order, with its belief
            self.plant_error = f"{type(error).__name__}: {error}"
            logger.warn(f"plant.step failed, which ends the episode: {self.plant_error}")
            y = np.nan
        self._batch.set_measured_sample(u, y)
        self._batch.step(action)


def as_number(method_name: str, value: Any) -> float:
    """The return value of a plant's method as a number.

    Raises:
        TypeError: for anything but a number or an array that holds one.
    """
    try:
        number = value.item() if isinstance(value, np.ndarray) else value
        if isinstance(number, str | bytes):  # float() reads text, too
            raise TypeError
        return float(number)
    except (TypeError, ValueError):
        raise TypeError(f"{method_name} must give one number, but gave {short_repr(value)}") from None
