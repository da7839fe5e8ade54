"""A rig around the plant itself: an object that takes inputs and gives outputs in the rig's units."""

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
from duffing_env.experiment_config import MAX_SAMPLES, Experiment, check_prior
from duffing_env.rewards.reward_registry import kernel_reward
from estimator.belief import Belief
from estimator.inference.noise_grid import NoiseGridSize
from estimator.models.model import Model
from estimator.models.named_parameters import Parameters
from estimator.rigs.rig import Rig
from estimator.rigs.rig_prior import equal_effect_log_ratio, reset_state, rig_prior
from estimator.rigs.units import Scales
from estimator.support.argument_checks import check_integer, short_repr

RigLike = Rig | Mapping[str, Any] | str | Path

#: How several plants are played.
ONE_PLANT_MESSAGE = (
    "one plant is one environment; for several use "
    "gymnasium.vector.SyncVectorEnv([lambda: gym.make('duffing_env/Rig-v0', rig=rig, plant=plant_1), ...])"
)


class Plant(Protocol):
    """What a plant is: a simulator, a circuit behind a converter, a process behind a socket."""

    def reset(self) -> object:
        """Bring the plant to rest, with no input; what is returned is not looked at."""

    def step(self, u: float) -> SupportsFloat | npt.NDArray[Any]:
        """Apply the input u for one sampling step, and give the output at its end, both in the rig's units.

        The output is one number, or an array that holds one.
        """
        ...


def playable_rig(rig: RigLike | None, needs_guess: bool = True) -> Rig:
    """The rig of an environment.

    An input that a generator smooths between samples (``look_ahead``, ``spline``) cannot be known sample by sample: an
    environment's goes linearly from one to the next instead.

    Raises:
        ValueError: for none, one without limit, range or guess, one with a delay, or one whose motion is guessed but
            whose sensor stands so far off that its range says nothing of the motion.
    """
    if rig is None:
        raise ValueError("rig must be a Rig, a dictionary or a file name, but is None; pass rig='rig.toml'")
    rig = Rig.from_any(rig)
    needed = {"input.limit": rig.input.limit, "output.range": rig.output.range, "guess": rig.guess}
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
            f"output.offset must be within half of the range, which the motion is guessed by, but is {sensor.offset:g} "
            f"of {sensor.range:g} {sensor.unit}; subtract it from the output, and give the range of the motion"
        )
    return rig


class RigScaling:
    """What experiments on a rig share."""

    rig: RigLike | None
    max_input: float
    max_output: float

    #: A guess is wide.
    uses_cubature: ClassVar[bool] = True

    def _check_fractions(self) -> None:
        for name in ("max_input", "max_output"):
            if getattr(self, name) > 1:
                raise ValueError(f"{name} must be at most 1, the rig's own limit, but is {getattr(self, name)!r}")

    @property
    def validated_rig(self) -> Rig:
        """The rig."""
        assert isinstance(self.rig, Rig)
        return self.rig

    @property
    def degree(self) -> int:
        """Of the input over a sample: held, or linear from the last to this one."""
        return int(self.validated_rig.interpolation != "zero_order")

    @property
    def step(self) -> float:
        """The rig's."""
        return float(self.validated_rig.step)

    @property
    def scales(self) -> Scales:
        """The rig's."""
        return self.validated_rig.scales


@dataclass(frozen=True)
class RigPlantExperiment(RigScaling, Experiment):
    """An experiment on a rig's plant itself, whose parameters nobody knows.

    `duffing_env.tracks.rig_env.RigEnv` says what its options are. Seven values of each noise reach over three decades.

    Attributes:
        prior: the belief that every episode starts from, in the rig's scales; what the guess says where it is None.
            With one the rig needs no guess. The state of an oscillator's does not count.
    """

    rig: RigLike | None = None
    max_input: float = 1.0
    max_output: float = 1.0
    horizon: int = 256
    prior: Belief | None = None
    noise_hypotheses: NoiseGridSize = (7, 7)

    knows_truth: ClassVar[bool] = False

    def __post_init__(self) -> None:
        object.__setattr__(self, "rig", playable_rig(self.rig, self.prior is None))
        if self.prior is not None:
            check_prior(self.prior, self.scales)
        # A posterior's state is that of the end of its record, and the plant is brought to rest.
        prior = rig_prior(self.validated_rig) if self.prior is None else reset_state(self.prior)
        object.__setattr__(self, "prior", prior)
        super().__post_init__()
        self._check_fractions()
        check_integer("horizon", self.horizon, MAX_SAMPLES)
        if kernel_reward(self.reward).needs_truth:
            raise ValueError(
                f"reward must not be {self.reward!r} for a plant of one's own, whose true oscillator nobody knows; "
                "use 'information_gain', 'expected_free_energy' or 'free_energy'"
            )
        if self.observation == "privileged":
            raise ValueError("observation must not be 'privileged' for a plant of one's own, whose truth nobody knows")
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
        """That of the prior, where each noise is unknown by itself."""
        return equal_effect_log_ratio(self.prior_belief) if isinstance(self.noise_hypotheses, tuple) else None

    @property
    def model(self) -> Model:
        """That of the prior."""
        return self.prior_belief.model

    @property
    def nominal_parameters(self) -> dict[str, float]:
        """What the prior believes, inside: nobody knows the plant."""
        dimensions = self.model.dimensions
        parameters = self.prior_belief.parameters()
        return {
            name: mean / self.scales.factor(dimensions.get(name, (0, 0, 0))) for name, (mean, *_) in parameters.items()
        }

    @cached_property
    def prior_belief(self) -> Belief:
        """The prior."""
        assert self.prior is not None
        return self.prior


class RigPlantEnv(DuffingEnv):
    r"""A rig around its plant; what ``Rig-v0`` is with ``plant=``.

    What the plant gets is what the estimator is told: the action in float32, clipped to [-1, 1], times ``max_input``
    and the rig's limit. ``step`` has to keep the time: it returns when the sample is there. Nothing is applied between
    two calls of the environment's ``step``, and nothing after the end of an episode until ``reset``: that of the plant
    must switch its input off. The compiled step is ready before the plant is first touched. With ``hold`` the plant's
    ``step`` is called for every sample, with the same input.

    Rewards that compare with the true oscillator are refused, because nobody knows it: there is no
    ``log_posterior_gain`` in the info, and ``env.unwrapped.truth`` raises AttributeError. A plant that raises an
    exception or gives something that is not a finite number ends the episode (``info["diverged"]``), and leaves the
    belief as it was before that step. Where it raised, or gave what is no number at all, there is a warning, too, and
    ``env.unwrapped.plant_error`` is the exception's type and message until the next reset; otherwise it is None, also
    after NaN. An exception in ``plant.reset()`` comes out of ``reset``, and no episode has begun.

    A plant and a prior are Python objects, so the specification of an environment made with them is not JSON-able; and
    an environment is copied and pickled with its plant, if the plant can be. One plant is one environment: that which
    reset it last. Another one around it, whose episode was still going on, raises ``ResetNeeded`` in ``step``, and the
    plant gets nothing.

    Args:
        plant: it stays the caller's, who closes it.
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
        # A plant would wait for the compiler with its first input on.
        self._batch.step(0.0)

    @property
    def truth(self) -> Parameters:
        """The plant's true parameters are not known.

        Raises:
            AttributeError: always.
        """
        raise AttributeError("nobody knows the true parameters of a plant of one's own; ask for env.unwrapped.belief")

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Bring the plant to rest and start an episode; ``options`` has no keys, and the plant is not told the seed."""
        return super().reset(seed=seed, options=options)

    def _reset_plant(self) -> None:
        self._running, self.plant_error = False, None
        self._last_env_of_plant[id(self.plant)] = self
        self.plant.reset()

    def _apply_sample(self, action: float) -> None:
        if self._last_env_of_plant.get(id(self.plant), self) is not self:
            raise ResetNeeded(
                f"plant must not be shared, but another environment has reset it meanwhile: {ONE_PLANT_MESSAGE}"
            )
        scales = self.experiment.scales
        u = self.max_input * float(np.float32(action))
        try:
            y = as_number("step", self.plant.step(scales.input * u)) / scales.output
        except Exception as error:  # whatever it is: the episode ends in order, and its belief is told
            self.plant_error = f"{type(error).__name__}: {error}"
            logger.warn(f"plant.step failed, which ends the episode: {self.plant_error}")
            y = np.nan
        self._batch.set_measured_sample(u, y)
        self._batch.step(action)


def as_number(method_name: str, value: Any) -> float:
    """The number that a method of a plant gave.

    Raises:
        TypeError: for what is neither a number nor an array that holds one.
    """
    try:
        number = value.item() if isinstance(value, np.ndarray) else value
        if isinstance(number, str | bytes):  # float() reads text, too
            raise TypeError
        return float(number)
    except (TypeError, ValueError):
        raise TypeError(f"{method_name} must give one number, but gave {short_repr(value)}") from None
