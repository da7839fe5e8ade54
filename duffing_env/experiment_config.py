"""The options of an experiment: limits, noises, priors, the estimator and the reward.

The fields of these classes are the keyword arguments of `gymnasium.make`; JSON can hold all but functions and beliefs.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar

import numpy as np

from duffing_env.belief_arrays import Beliefs, check_observation
from duffing_env.input_options import ByInput, check_has_inputs, checked_by_input, numbers_by_input
from duffing_env.prior_checks import check_nominal_parameters, check_prior
from duffing_env.rewards.named_rewards import check_reward, kernel_reward
from duffing_env.storage.kernel_spec import KernelParams, KernelSpec, parameter_names
from duffing_env.storage.random_streams import SEED_BRANCHES
from estimator.belief import Belief
from estimator.inference.noise_grid import NoiseGridSize, initial_weights, member_priors, mixture_record
from estimator.models.difference_equation import difference
from estimator.models.model import Model
from estimator.priors import log_uniform_moments, weak_prior
from estimator.rigs.silverbox_constants import SILVERBOX_ODE_TWIN, SILVERBOX_SAMPLING_STEP, SILVERBOX_TWIN
from estimator.rigs.units import Scales
from estimator.settings import checked_noise_hypotheses
from estimator.support.argument_checks import (
    MAX_MAGNITUDE,
    check_bool,
    check_choice,
    check_integer,
    check_number,
)
from estimator.support.array_types import FloatArray
from estimator.support.update_options import DEFAULT_ITERATIONS, MAX_ITERATIONS

#: Largest number of noise ratios, or of values of each noise: more are not worth their time.
MAX_HYPOTHESES = 99

#: Largest number of samples of an episode, or of an action.
MAX_SAMPLES = 10**9

#: Smallest and largest relative half width of a parameter's range.
SPREAD_LIMITS = 1e-6, 0.999


@dataclass(frozen=True)
class Experiment:
    """The options of all experiments; `duffing_env.env.DuffingEnv` describes them."""

    factorisation: str = "structured"
    iterations: int | None = None
    reward: str | Callable[..., Any] = "information_gain"
    observation: str | Callable[[Beliefs], Any] = "posterior"
    history: int = 16
    max_input: ByInput = 0.15
    max_output: float = 0.6
    hold: int = 1
    terminal: bool = False
    terminated_return: float | None = None
    noise_hypotheses: NoiseGridSize = 1
    branch: str = "train"

    #: Whether there is a true plant to compare with.
    knows_truth: ClassVar[bool] = True
    #: Whether sigma points propagate the beliefs of several noise hypotheses: for wide beliefs and nonlinear models.
    uses_cubature: ClassVar[bool] = False

    def __post_init__(self) -> None:
        check_choice("branch", self.branch, SEED_BRANCHES)
        check_choice("factorisation", self.factorisation, DEFAULT_ITERATIONS)
        if self.iterations is not None:
            check_integer("iterations", self.iterations, MAX_ITERATIONS)
        check_reward(self.reward)
        if callable(self.reward) and (self.terminal or self.terminated_return is not None):
            raise ValueError("terminal and terminated_return must be left out where reward is a function")
        check_observation(self.observation, self.history)
        # A larger limit lets an oscillator diverge, and its episode end.
        check_number("max_output", self.max_output, maximum=1e300)
        check_has_inputs(self.model)
        object.__setattr__(self, "max_input", checked_by_input("max_input", self.max_input, self.model, 1e300))
        check_integer("hold", self.hold, MAX_SAMPLES)
        check_bool("terminal", self.terminal)
        if self.terminated_return is not None:
            check_number(
                "terminated_return", self.terminated_return, -MAX_MAGNITUDE, MAX_MAGNITUDE, "None keeps what was gained"
            )
        hypotheses = checked_noise_hypotheses(self.noise_hypotheses, self.factorisation, MAX_HYPOTHESES)
        object.__setattr__(self, "noise_hypotheses", hypotheses)

    @property
    def samples(self) -> int:
        """Samples of an episode without an early end."""
        raise NotImplementedError

    @property
    def model(self) -> Model:
        """The model of the belief."""
        return difference()

    @property
    def plant(self) -> Model | None:
        """The model that is simulated; None where a record is replayed."""
        return None

    @property
    def truth_model(self) -> Model:
        """The model with the true parameters."""
        return self.plant or self.model

    @property
    def degree(self) -> int:
        """Degree of the input over a sample of a differential equation: 0 held, 1 linear from the last input on."""
        return 0

    @property
    def step(self) -> float:
        """Sampling step [s]."""
        return SILVERBOX_SAMPLING_STEP

    @property
    def scales(self) -> Scales:
        """Factors from internal to physical units."""
        return Scales(self.step)

    @property
    def prior_belief(self) -> Belief:
        """The belief that every episode starts from."""
        raise NotImplementedError

    @property
    def nominal_parameters(self) -> dict[str, float]:
        """The plant in the middle of the range: the twin of the Silverbox circuit; 1 for parameters of other models."""
        twin = SILVERBOX_ODE_TWIN if self.truth_model.is_continuous else SILVERBOX_TWIN
        return {name: twin.get(name, 1.0) for name in parameter_names(self.truth_model)}

    @property
    def max_inputs(self) -> FloatArray:
        """(inputs,) inputs of the action 1, in the order of the model."""
        return numbers_by_input(self.max_input, self.model)  # type: ignore[arg-type]

    @property
    def replayed_record(self) -> FloatArray:
        """(inputs + 1, T) recorded inputs and outputs; one sample where the plant is simulated."""
        return np.zeros((self.model.n_inputs + 1, 1))

    @property
    def plant_params(self) -> dict[str, Any]:
        """The fields of `KernelParams` that describe the plant."""
        return {}

    @property
    def likeliest_log_noise_ratio(self) -> float | None:
        """The likeliest noise ratio before data, as a logarithm (`estimator.inference.noise_grid.initial_weights`)."""
        return None

    @property
    def _n_iterations(self) -> int:
        return int(self.iterations or DEFAULT_ITERATIONS[self.factorisation])

    @property
    def kernel_spec(self) -> KernelSpec:
        """The kind of the experiment, which the kernel is compiled for."""
        return KernelSpec(
            self.model, self.plant, self.degree, self.factorisation,
            self._n_iterations if self.factorisation == "structured" else 0,
            str(self.reward) if kernel_reward(self.reward).compile_hooks else "",
            self.noise_hypotheses != 1, self.uses_cubature and self.noise_hypotheses != 1,
        )  # fmt: skip

    @property
    def kernel_params(self) -> KernelParams:
        """The run-time parameters of the kernel."""
        prior, model, names = self.prior_belief, self.model, parameter_names(self.truth_model)
        first_record, plant_fields = prior.record, dict(self.plant_params)
        if self.noise_hypotheses != 1:
            members = member_priors(prior, self.noise_hypotheses)
            noises = members[:, -2 - 2 * model.n_outputs :]
            weights = initial_weights(noises, self.likeliest_log_noise_ratio)
            first_record = mixture_record(members, len(model.names), weights)
            plant_fields["hypothesis_priors"] = np.column_stack([noises, weights])
        precisions = first_record[-2 - 2 * model.n_outputs :]
        values: dict[str, Any] = {
            "max_input": self.max_inputs,
            "max_output": float(self.max_output),
            "horizon": float(self.samples),
            "iterations": self._n_iterations,
            "step": self.step,
            "nominal_parameters": np.array([self.nominal_parameters[name] for name in names]),
            "parameter_stds": np.zeros(len(names)),
            "measurement_noise": np.zeros(self.truth_model.n_outputs),
            "walk_variances": np.zeros(model.n_coefficients),
            "reward_weights": np.array(kernel_reward(self.reward).weights),
            "terminal": self.terminal,
            "has_terminated_return": self.terminated_return is not None,
            "terminated_return": float(self.terminated_return or 0.0),
            "prior": first_record.copy(),
            "prior_inverse_std": 1.0 / np.sqrt(np.diag(prior.coefficients_cov)),
            "prior_log_precisions": np.log(precisions[::2] / precisions[1::2]),
            "max_slew": np.full(model.n_inputs, np.inf),
            "sqrt_input_cost": np.zeros(model.n_inputs),
            "sensor_limits": np.full(self.truth_model.n_outputs - 1, np.inf),
        }
        return KernelParams(**(values | plant_fields))


@dataclass(frozen=True)
class SimulatedExperiment(Experiment):
    """An experiment on the plant ``difference``, with a new oscillator in every episode.

    `duffing_env.env.DuffingEnv` describes its options.
    """

    horizon: int = 256
    process_noise: float = 5e-4
    measurement_noise: float = 5e-4
    spread: float = 0.3
    noise_range: float = 1.0
    process_noise_guess: float | None = None
    measurement_noise_guess: float | None = None
    noise_shape: float = 2.0
    mean: Mapping[str, float] | None = None
    prior: Belief | None = None
    plant_spread: float | None = None
    max_rms: float | None = None
    max_slew: ByInput | None = None
    input_cost: float = 0.0
    jump: float = 0.0
    drift: float = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        check_integer("horizon", self.horizon, MAX_SAMPLES)
        for name in ("process_noise", "measurement_noise", "noise_shape"):
            check_number(name, getattr(self, name))
        check_number("spread", self.spread, *SPREAD_LIMITS, "masses are positive, and none is known so well before")
        if self.plant_spread is not None:
            check_number("plant_spread", self.plant_spread, 0, SPREAD_LIMITS[1], "0 is the twin itself")
        for name in ("max_rms", "process_noise_guess", "measurement_noise_guess"):
            if getattr(self, name) is not None:
                check_number(name, getattr(self, name))
        if self.max_slew is not None:
            object.__setattr__(self, "max_slew", checked_by_input("max_slew", self.max_slew, self.model))
        check_number("noise_range", self.noise_range, 1, MAX_MAGNITUDE, "1 draws no noises")
        for name, limit in (("input_cost", MAX_MAGNITUDE), ("jump", SPREAD_LIMITS[1]), ("drift", 1.0)):
            check_number(name, getattr(self, name), 0, limit, "0 does without it")
        check_nominal_parameters(self.mean, parameter_names(self.plant))
        if self.prior is not None:
            check_prior(self.prior, self.scales, self.model)
        if self.drift and self.factorisation == "mean_field":
            raise ValueError(f"drift must be 0 in mean field, which cannot track changes, but is {self.drift!r}")

    @property
    def samples(self) -> int:
        """The horizon."""
        return self.horizon

    @property
    def plant(self) -> Model:
        """The paper's difference equation."""
        return difference()

    @property
    def nominal_parameters(self) -> dict[str, float]:
        """The twin, with the option ``mean`` in its place where given."""
        return super().nominal_parameters | {name: float(value) for name, value in (self.mean or {}).items()}

    @cached_property
    def prior_belief(self) -> Belief:
        """The option ``prior``, or the prior that fits the range of the plants and the noises."""
        if self.prior is not None:
            return self.prior.with_factorisation(self.factorisation)
        return self.prior_for_model(self.model, self.factorisation)

    def prior_for_model(self, model: Model, factorisation: str = "structured") -> Belief:
        """The prior that fits the range of the plants, for any model with the plant's parameters."""
        noises = *self.prior_noise_stds, self.noise_shape
        return weak_prior(model, *self.coefficient_moments(model), *noises, scales=self.scales).with_factorisation(
            factorisation
        )

    def coefficient_moments(self, model: Model) -> tuple[FloatArray, FloatArray]:
        """Mean (K,) and covariance (K, K) of the coefficients over the range of the plants."""
        for name, value in self.nominal_parameters.items():
            if value == 0:
                raise ValueError(f"mean[{name!r}] must not be 0, as its range is relative; give a prior as well")
        return log_uniform_moments(model, self.nominal_parameters, self.spread, self.scales)

    @property
    def prior_noise_stds(self) -> tuple[float, float]:
        """Standard deviations at the centres of the priors of γ and of the first sensor's ξ."""
        process, sensor = self.process_noise_guess, self.measurement_noise_guess
        return (
            float(self.process_noise if process is None else process),
            float(self.measurement_noise if sensor is None else sensor),
        )

    @property
    def plant_params(self) -> dict[str, Any]:
        """The noises, and the range of the plants."""
        return {
            "process_noise": float(self.process_noise),
            "measurement_noise": np.full(self.plant.n_outputs, float(self.measurement_noise)),
            "noise_range": float(self.noise_range),
            "spread": float(self.spread if self.plant_spread is None else self.plant_spread),
            "budget": np.inf if self.max_rms is None else self.horizon * self.max_rms * self.max_rms,
            "max_slew": numbers_by_input(self.max_slew, self.model),  # type: ignore[arg-type]
            "sqrt_input_cost": float(np.sqrt(self.input_cost)) / self.max_inputs,
            "jump": float(self.jump),
            "has_drift": self.drift > 0,
            "walk_variances": self.drift**2 * np.diag(self.prior_belief.coefficients_cov),
        }
