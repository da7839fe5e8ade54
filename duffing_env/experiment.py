"""What is fixed about an experiment: limits, noises, priors, the estimator and the reward.

The fields of these classes are the keyword arguments of `gymnasium.make`; all of them are JSON-able.
"""

from __future__ import annotations

import difflib
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any

import numpy as np

from duffing_env.layout import OSCILLATOR, SETTINGS
from duffing_env.rewards import reward_number
from estimator.belief import Belief, RecordBelief
from estimator.continuous import CONTINUOUS_TWIN, ContinuousBelief, continuous_prior
from estimator.inference import DEFAULT_ITERATIONS
from estimator.parameters import SAMPLING_STEP, SILVERBOX_TWIN, FloatArray, PhysicalParameters
from estimator.prior import Prior
from estimator.record import COEFFICIENTS, RECORD


@dataclass(frozen=True)
class Experiment:
    r"""What all experiments have.

    Attributes:
        factorisation: of the estimator: ``structured`` or ``mean_field``.
        iterations: variational iterations per sample; 3 structured and 10 mean field where it is None.
        reward: its name, see `duffing_env.rewards`.
        max_input: input of the action 1 [V].
        max_output: displacement limit [V]: the episode ends at \|y\| above it.
        hold: samples that an action is applied for; a step's reward is the sum of theirs. An episode may end within.
        terminal: whether the episode's whole reward is paid in its last step, and 0 before.
        terminated_return: what an episode that is terminated returns, whatever it gained. None keeps what it gained.
    """

    factorisation: str = "structured"
    iterations: int | None = None
    reward: str = "information_gain"
    max_input: float = 0.15
    max_output: float = 0.6
    hold: int = 1
    terminal: bool = False
    terminated_return: float | None = None

    def __post_init__(self) -> None:
        if self.factorisation not in list(DEFAULT_ITERATIONS):
            raise ValueError(f"factorisation must be one of {list(DEFAULT_ITERATIONS)}, but is {self.factorisation!r}")
        if self.iterations is not None:
            self._check_count("iterations")
        reward_number(self.reward)
        self._check_positive("max_input")
        self._check_positive("max_output")
        self._check_count("hold")
        self._check_flag("terminal")
        worth = self.terminated_return
        if worth is not None and not (_is_number(worth) and np.isfinite(worth)):
            raise ValueError(f"terminated_return must be a finite number, but is {worth!r}; None keeps what was gained")

    def _check_positive(self, name: str) -> None:
        value = getattr(self, name)
        if not (_is_number(value) and 0 < value < np.inf):
            raise ValueError(f"{name} must be a positive, finite number, but is {value!r}; pass a value above 0")

    def _check_flag(self, name: str) -> None:
        if not isinstance(getattr(self, name), bool):
            raise ValueError(f"{name} must be True or False, but is {getattr(self, name)!r}")

    def _check_count(self, name: str) -> None:
        value = getattr(self, name)
        if not isinstance(value, int | np.integer) or isinstance(value, bool) or value < 1:
            raise ValueError(f"{name} must be a whole number of at least 1, but is {value!r}")

    @property
    def samples(self) -> int:
        """Samples of an episode that no limit ends."""
        raise NotImplementedError

    @property
    def believed(self) -> Prior:
        """The belief that every episode starts from."""
        raise NotImplementedError

    @property
    def twin(self) -> PhysicalParameters:
        """The oscillator in the middle of the range."""
        return SILVERBOX_TWIN

    @property
    def plant_kind(self) -> str:
        """The plant's name in `duffing_env.kernel.PLANTS`."""
        return "difference"

    @property
    def estimator_kind(self) -> str:
        """The estimator's name in `duffing_env.kernel.ESTIMATORS`."""
        return self.factorisation

    @property
    def is_nonlinear(self) -> bool:
        """Whether the estimator's model has the cubic term."""
        return True

    @property
    def recorded(self) -> tuple[FloatArray, FloatArray]:
        """Recorded input and output [V]; of one sample each where the plant is simulated."""
        return np.zeros(1), np.zeros(1)

    @property
    def plant_settings(self) -> dict[str, float]:
        """Entries of `SETTINGS` that describe the plant."""
        return {}

    @property
    def prior_record(self) -> FloatArray:
        """The prior as the record (RECORD_SIZE,) that the kernel copies at a reset."""
        return self.believed.to_record(factorisation=self.factorisation, nonlinear=self.is_nonlinear)

    def to_belief(self, record: FloatArray) -> RecordBelief:
        """The readable face of a record (RECORD_SIZE,)."""
        return Belief(record, self.factorisation, self.is_nonlinear)

    @property
    def settings(self) -> FloatArray:
        """The experiment as the kernel is told of it, (len(SETTINGS),)."""
        prior = dict(zip(RECORD, self.prior_record, strict=True))
        values = {
            "max_input": self.max_input,
            "max_output": self.max_output,
            "horizon": self.samples,
            "hold": 1,
            "process_noise": 0.0,
            "measurement_noise": 0.0,
            "budget": np.inf,
            "max_slew": np.inf,
            "input_cost": 0.0,
            "jump": 0.0,
            **{f"walk_{c}": 0.0 for c in COEFFICIENTS},
            "spread": 0.0,
            **{f"center_{name}": getattr(self.twin, name) for name in OSCILLATOR},
            "step": SAMPLING_STEP,
            "reward": reward_number(self.reward),
            "terminal": self.terminal,
            "forfeits": self.terminated_return is not None,
            "terminated_return": self.terminated_return or 0.0,
            "iterations": self.iterations or DEFAULT_ITERATIONS[self.factorisation],
            "as_published": False,
            "nonlinear": self.is_nonlinear,
            "delay": 0,
            **{f"prior_{c}": prior[c] for c in ("t1", "t2", "t3", "e")},
            **{f"scale_{c}": _inverse_std(prior[f"P_{c}_{c}"]) for c in ("t1", "t2", "t3", "e")},
            "prior_log_gamma": np.log(prior["g_shape"] / prior["g_rate"]),
            "prior_log_xi": np.log(prior["n_shape"] / prior["n_rate"]),
            **self.plant_settings,
        }
        return np.array([values[name] for name in SETTINGS], dtype=np.float64)


@dataclass(frozen=True)
class SimulatedExperiment(Experiment):
    """An experiment on the plant ``difference``, with a new oscillator in every episode.

    Attributes:
        horizon: samples of an episode; it is then truncated.
        process_noise: standard deviation of the process noise w̃, on x [V].
        measurement_noise: standard deviation of the measurement noise v, on y [V].
        spread: m, c, a and b are drawn log-uniformly on the twin's value * [1 - spread, 1 + spread]; in (0, 1).
        noise_shape: shape of the Gamma priors of γ and ξ, which are centred on the true precisions; 2 is weak.
        plant_spread: as ``spread``, for the plant alone, whose range the prior then does not match: with 0 every
            oscillator is the twin itself. That of the prior where it is None.
        max_rms: the input's root mean square over a whole episode [V]: the energy horizon * max_rms² is a budget, and
            an input that what is left of it cannot pay for is cut to what it can. No budget where it is None.
        max_slew: largest change of the input from sample to sample [V]; a larger one is cut. None: no limit.
        input_cost: taken off the reward for every (u / max_input)².
        jump: the mass jumps once, at a sample that is uniform over the middle half of the episode, by a factor
            log-uniform on [1 - jump, 1 + jump]; in [0, 1). 0: it stays.
        drift: how far the estimator lets each coefficient walk in a sample: standard deviation, in parts of the
            prior's. 0: it takes the coefficients for constant.
    """

    horizon: int = 256
    process_noise: float = 5e-4
    measurement_noise: float = 5e-4
    spread: float = 0.3
    noise_shape: float = 2.0
    plant_spread: float | None = None
    max_rms: float | None = None
    max_slew: float | None = None
    input_cost: float = 0.0
    jump: float = 0.0
    drift: float = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        self._check_count("horizon")
        for name in ("process_noise", "measurement_noise", "spread", "noise_shape"):
            self._check_positive(name)
        if self.spread >= 1:
            raise ValueError(f"spread must be below 1, but is {self.spread!r}; masses are positive")
        if self.plant_spread is not None and not (_is_number(self.plant_spread) and 0 <= self.plant_spread < 1):
            raise ValueError(f"plant_spread must be in [0, 1), but is {self.plant_spread!r}; 0 is the twin itself")
        for name in ("max_rms", "max_slew"):
            if getattr(self, name) is not None:
                self._check_positive(name)
        for name, limit in (("input_cost", np.inf), ("jump", 1.0), ("drift", np.inf)):
            value = getattr(self, name)
            if not (_is_number(value) and 0 <= value < limit):
                raise ValueError(f"{name} must be in [0, {limit}), but is {value!r}; 0 does without it")
        if self.drift and self.factorisation == "mean_field":
            raise ValueError(f"drift must be 0 in mean field, which cannot follow, but is {self.drift!r}")

    @property
    def samples(self) -> int:
        """The horizon."""
        return self.horizon

    @cached_property
    def believed(self) -> Prior:
        """The prior that fits oscillators so drawn, and the noises."""
        return Prior.silverbox_twin(self.spread, self.process_noise, self.measurement_noise, self.noise_shape)

    @property
    def plant_settings(self) -> dict[str, float]:
        """The noises, and the range of the oscillators."""
        return {
            "process_noise": self.process_noise,
            "measurement_noise": self.measurement_noise,
            "spread": self.spread if self.plant_spread is None else self.plant_spread,
            "budget": np.inf if self.max_rms is None else self.horizon * self.max_rms * self.max_rms,
            "max_slew": np.inf if self.max_slew is None else self.max_slew,
            "input_cost": self.input_cost / self.max_input / self.max_input,
            "jump": self.jump,
            **{f"walk_{c}": (self.drift * std) ** 2 for c, std in zip(COEFFICIENTS, self._prior_stds, strict=True)},
        }

    @property
    def _prior_stds(self) -> FloatArray:
        prior = dict(zip(RECORD, self.prior_record, strict=True))
        return np.sqrt([prior[f"P_{c}_{c}"] for c in COEFFICIENTS])


@dataclass(frozen=True)
class ContinuousExperiment(SimulatedExperiment):
    """An experiment on the plant ``sde``, with a new oscillator in every episode.

    The fields of `SimulatedExperiment` are the same, but for ``process_noise``: the standard deviation of what one
    sample's process noise alone does to x [V]. Oscillators are drawn about `CONTINUOUS_TWIN`.

    Attributes:
        estimator: ``ode``, the plant's own equation, structured; or ``nlarx``, the paper's difference equation, which
            no plant of this kind obeys.
    """

    estimator: str = "ode"

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.estimator not in ["ode", "nlarx"]:
            raise ValueError(f"estimator must be one of ['ode', 'nlarx'], but is {self.estimator!r}")
        if self.reward == "fisher":
            raise ValueError("reward must not be 'fisher' here: it is that of the difference equation, not the plant's")
        if self.estimator == "ode" and self.factorisation != "structured":
            raise ValueError(
                f"factorisation must be 'structured' for estimator='ode', but is {self.factorisation!r}; mean field "
                f"is for estimator='nlarx'"
            )

    @property
    def twin(self) -> PhysicalParameters:
        """The circuit as the differential equation sees it."""
        return CONTINUOUS_TWIN

    @property
    def plant_kind(self) -> str:
        """The differential equation."""
        return "sde"

    @property
    def estimator_kind(self) -> str:
        """The plant's equation, or the factorisation of the paper's."""
        return "ode" if self.estimator == "ode" else self.factorisation

    @cached_property
    def believed(self) -> Prior:
        """The prior of ``nlarx`` that fits oscillators so drawn, by Eq. (3)."""
        noises = self.process_noise, self.measurement_noise, self.noise_shape
        return Prior.silverbox_twin(self.spread, *noises, center=self.twin)

    @property
    def physical_prior(self) -> ContinuousBelief:
        """The prior of ``ode`` that fits oscillators so drawn, and the noises."""
        noises = self.process_noise, self.measurement_noise, self.noise_shape
        return continuous_prior(self.twin, self.spread, *noises)

    @property
    def prior_record(self) -> FloatArray:
        """That of the estimator at hand."""
        return super().prior_record if self.estimator == "nlarx" else self.physical_prior.record

    def to_belief(self, record: FloatArray) -> RecordBelief:
        """The readable face of a record (RECORD_SIZE,)."""
        return ContinuousBelief(record) if self.estimator == "ode" else super().to_belief(record)


def make_experiment(kind: type[Experiment], options: dict[str, Any]) -> Experiment:
    """An experiment from keyword arguments; ValueError for an unknown one, with the nearest known."""
    known = [field.name for field in fields(kind)]
    for name in options:
        if name not in known:
            near = difflib.get_close_matches(name, known, 1)
            hint = f"; did you mean {near[0]!r}?" if near else ""
            raise ValueError(f"{name}={options[name]!r} is no option of this environment, which has {known}{hint}")
    return kind(**options)


def _is_number(value: object) -> bool:
    return isinstance(value, int | float | np.number) and not isinstance(value, bool)


def _inverse_std(variance: float) -> float:
    return 1.0 / np.sqrt(variance) if variance > 0 else 0.0
