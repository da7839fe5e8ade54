"""Any model as an environment: `ModelEnv`, whose tracks are entries of `duffing_env.tracks.track_registry`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar

import numpy as np

from duffing_env.env import DuffingEnv
from duffing_env.experiment_config import Experiment, SimulatedExperiment
from duffing_env.input_options import checked_by_input, numbers_by_input
from duffing_env.storage.kernel_spec import parameter_names
from duffing_env.vector_env import DuffingVectorEnv
from estimator.belief import Belief
from estimator.models import MODELS
from estimator.models.model import Model
from estimator.priors import gaussian_moments, weak_prior
from estimator.rigs.stated_units import model_near_one
from estimator.rigs.units import Scales
from estimator.support.argument_checks import MAX_MAGNITUDE, check_choice, check_number, short_repr
from estimator.support.array_types import FloatArray


@dataclass(frozen=True)
class ModelExperiment(SimulatedExperiment):
    """An experiment on any model, which is plant and belief at once; `ModelEnv` describes its options."""

    system: str | Model | Mapping[str, Any] = "difference"
    mean: Mapping[str, float] | None = None
    std: Mapping[str, float] | None = None
    sampling_step: float = 1.0
    interpolation: str = "zero_order"
    sensor_noise: tuple[float, ...] | None = None
    sensor_limits: tuple[float, ...] | None = None

    #: A model may be too nonlinear for a linearised update.
    uses_cubature: ClassVar[bool] = True

    def __post_init__(self) -> None:
        super().__post_init__()
        names = parameter_names(self.plant)
        for name, given in (("mean", self.mean), ("std", self.mean if self.std is None else self.std)):
            if not isinstance(given, Mapping) or set(given) != set(names):
                raise ValueError(f"{name} must give the parameters {list(names)}, but is {given!r}")
        for parameter, value in (self.std or {}).items():
            check_number(f"std of {parameter}", value)
        if self.std is not None and self.plant_spread not in (None, 0):
            raise ValueError(
                f"plant_spread must be 0 or left out where std gives the range of the plants, but is "
                f"{self.plant_spread!r}"
            )
        check_number("sampling_step", self.sampling_step)
        check_choice("interpolation", self.interpolation, ("zero_order", "linear"))
        if self.factorisation != "structured":
            raise ValueError(f"factorisation must be 'structured' for a model, but is {self.factorisation!r}")
        sensors = list(self.plant.outputs)[1:]
        for name, further in (("sensor_noise", self.sensor_noise), ("sensor_limits", self.sensor_limits)):
            if further is not None and (not isinstance(further, list | tuple) or len(further) != len(sensors)):
                raise ValueError(f"{name} must be for the sensors {sensors}, but is {short_repr(further)}")
            for number in further or ():
                check_number(name, number, maximum=1e300 if name == "sensor_limits" else MAX_MAGNITUDE)

    @cached_property
    def plant(self) -> Model:
        """The model."""
        system = self.system
        if isinstance(system, str):
            check_choice("system", system, MODELS)
            return MODELS[system]()
        if isinstance(system, Model):
            return self._in_samples(system)
        if not isinstance(system, Mapping) or not set(system) <= set(Model.__dataclass_fields__):
            raise ValueError(
                f"system must be one of {list(MODELS)}, a Model or its fields, but is {short_repr(system)}"
            )
        return self._in_samples(Model(**system))

    def _in_samples(self, model: Model) -> Model:
        """The model itself, or of one in seconds the model in samples, with states in parts of the limits."""
        if model.time == "sample":
            return model
        names = parameter_names(model)
        mean = (
            self.mean if isinstance(self.mean, Mapping) and set(self.mean) == set(names) else dict.fromkeys(names, 1.0)
        )
        max_inputs = numbers_by_input(checked_by_input("max_input", self.max_input, model), model).tolist()
        limits = dict.fromkeys(list(model.outputs)[:1], float(self.max_output))
        limits |= dict(zip(model.inputs, max_inputs, strict=True))
        # A limit may be as good as none, and powers of it must stay finite.
        sizes = {channel: min(max(limit, 1e-30), 1e30) for channel, limit in limits.items()}
        return model_near_one(model, Scales(self.step), mean, sizes)

    @property
    def model(self) -> Model:
        """The model itself."""
        return self.plant

    @property
    def degree(self) -> int:
        """Degree of the input over a sample."""
        return int(self.interpolation == "linear" and self.plant.is_continuous)

    @property
    def step(self) -> float:
        """The sampling step."""
        return float(self.sampling_step)

    @property
    def scales(self) -> Scales:
        """Outputs in the unit of the first state; inputs, where that is not a voltage, are counted as they are."""
        unit = next(iter(self.plant.states.values()))
        return Scales(self.step, input_unit="V" if unit == "V" else "1", output_unit=unit)

    @property
    def nominal_parameters(self) -> dict[str, float]:
        """The means."""
        assert self.mean is not None
        return {name: float(value) for name, value in self.mean.items()}

    @property
    def noises(self) -> list[float]:
        """Standard deviation of each sensor's noise."""
        first = float(self.measurement_noise)
        return [first, *(self.sensor_noise or [first] * (self.plant.n_outputs - 1))]

    def prior_for_model(self, model: Model, factorisation: str = "structured") -> Belief:
        """The prior that fits the range of the plants."""
        process, first = self.prior_noise_stds
        sensors = [first / self.measurement_noise * std for std in self.noises]  # all as far off as the first
        return weak_prior(
            model, *self.coefficient_moments(model), process, sensors, self.noise_shape, scales=self.scales
        )

    def coefficient_moments(self, model: Model) -> tuple[FloatArray, FloatArray]:
        """Mean (K,) and covariance (K, K) of the coefficients over the range of the plants."""
        if self.std is None:
            return super().coefficient_moments(model)
        return gaussian_moments(model, self.nominal_parameters, self.std, self.scales)

    @property
    def plant_params(self) -> dict[str, Any]:
        """The noises, and the range of the plants."""
        plant_fields = {**super().plant_params, "measurement_noise": np.array(self.noises)}
        if self.sensor_limits is not None:
            plant_fields["sensor_limits"] = np.array(self.sensor_limits, dtype=np.float64)
        if self.std is not None:
            scale = 0.0 if self.plant_spread == 0 else 1.0
            plant_fields["parameter_stds"] = scale * np.array([self.std[name] for name in parameter_names(self.plant)])
        return plant_fields


class ModelEnv(DuffingEnv):
    r"""Choose the input of a plant of any model so that its parameters are identified.

    ## Description

    As `DuffingEnv`, but the plant is an `estimator.models.model.Model`: the environment simulates it with its noises,
    and an estimator made from the same declaration keeps the observed posterior.

    ## Observation space

    `Box(2 K + K (K - 1) / 2 + n + 2 s + 4, float32)` for K coefficients, n states and s sensors, every entry clipped to
    its bounds: posterior means of the coefficients (deviation from the prior's, in its standard deviations), logarithms
    of their standard deviations relative to the prior's, their correlations, log E[γ] and log E[ξ] of each sensor
    relative to the prior's, the states and last outputs in parts of ``max_output``, the last input, the time and the
    energy that are left, in the order of `duffing_env.storage.kernel_spec.observation_bounds`.

    ## Starting state

    A plant at rest, drawn by ``mean``, ``std`` and ``spread``; the prior fits this range of plants.

    ## Episode end

    Terminated at \|y\| > ``max_output`` of the first sensor, where a further one exceeds its ``sensor_limits``, or at
    a number that is not finite; truncated after ``horizon`` samples.

    ## Belief

    The estimator linearises the model. For a strongly nonlinear model its intervals are too narrow: on
    ``WienerHammerstein-v0`` the 90 % intervals contain the truth in 68 to 84 % of cases, under binary inputs at the
    limit. With ``noise_hypotheses`` above 1 it propagates sigma points, and they contain it in 87 to 90 %
    (docs/evidence/coverage.md).

    ## Information

    Where noises are drawn (``noise_range``) and there are several sensors, ``truth`` has
    ``measurement_noise_<sensor>``.

    ## Arguments

    As `DuffingEnv`, and the following. With ``measurement_noise_guess`` the priors of all sensors are wrong by the same
    factor.

    | Argument | Default | Meaning |
    |----------|---------|---------|
    | ``system`` | | a name of `estimator.models.MODELS`, a `Model`, also in seconds, or a dict of its fields |
    | ``mean`` | | parameter to its mean, or without ``std`` to the middle of its range |
    | ``std`` | None | parameter to its standard deviation: Gaussian; None: log-uniform within ``spread`` |
    | ``plant_spread`` | ``spread`` | as in `DuffingEnv`; with ``std`` it may only be 0 |
    | ``sampling_step`` | 1 | seconds between two samples |
    | ``interpolation`` | ``zero_order`` | or ``linear``: the input of a differential equation between samples |
    | ``sensor_noise`` | None | standard deviations of the further sensors; None: the first sensor's |
    | ``sensor_limits`` | None | limits of the further sensors, in their units; None: they have none |

    >>> import gymnasium as gym
    >>> import duffing_env
    >>> env = gym.make("duffing_env/Pendulum-v0")
    >>> observation, info = env.reset(seed=0)
    >>> observation.shape
    (19,)

    ## Version history

    * v0: initial version
    """

    experiment_class: ClassVar[type[Experiment]] = ModelExperiment


class ModelVectorEnv(DuffingVectorEnv):
    """Many `ModelEnv` at once."""

    single_env_class: ClassVar[type[DuffingEnv]] = ModelEnv
