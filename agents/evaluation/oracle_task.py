"""The tasks that input is designed for: what its worth and its limits depend on, and the systems of a track."""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from agents.evaluation.batch import make
from agents.planner.ascent import climber
from agents.planner.design import Known
from agents.planner.plants import plant_of
from duffing_env.experiment import SimulatedExperiment
from duffing_env.vector_env import DuffingVectorEnv
from estimator.engine.feeding import input_degree
from estimator.information import variances
from estimator.models.difference import difference
from estimator.models.model import Model
from estimator.parameters import FloatArray

FOLDER = Path(__file__).parents[1] / "oracles"


@dataclass(frozen=True)
class Task:
    """What an oracle is for: everything that the worth of an input, and which inputs are allowed, depend on.

    Attributes:
        max_input: amplitude limit [V].
        max_output: limit of the displacement without noise [V].
        samples: of an episode.
        process_noise: standard deviation [V].
        measurement_noise: standard deviation [V].
        spread: of the prior.
        plant_spread: of the systems.
        max_rms: limit of the root mean square of the input over an episode [V]; None where there is none.
        model: the plant's equation.
        interpolation: of the input between samples.
    """

    max_input: float
    max_output: float
    samples: int
    process_noise: float
    measurement_noise: float
    spread: float
    plant_spread: float
    max_rms: float | None = None
    model: Model = field(default_factory=difference)
    interpolation: str = "zero_order"

    @classmethod
    def of(cls, envs: DuffingVectorEnv) -> Task:
        """The task of an environment; ValueError where its plant is none that is simulated and stays as it is."""
        e: Any = envs.experiment
        if not isinstance(e, SimulatedExperiment) or e.jump or e.max_slew is not None or e.noise_range > 1:
            raise ValueError(
                f"env must simulate a plant without jump, slew limit and range of noises, but is {e}; choose another "
                f"track"
            )
        spread = e.spread if e.plant_spread is None else e.plant_spread
        limits = e.max_input, e.max_output, e.samples, e.process_noise, e.measurement_noise, e.spread, spread, e.max_rms
        plant = plant_of(e)
        return cls(*limits, plant.model, plant.interpolation)

    @property
    def energy(self) -> float:
        """Limit of Σ u² [V²]."""
        return np.inf if self.max_rms is None else self.max_rms**2 * self.samples

    @property
    def noises(self) -> tuple[float, ...]:
        """Variances of the process noise and of each sensor's."""
        return variances(self.model, self.process_noise, self.measurement_noise)

    @property
    def degree(self) -> int:
        """Of the input's polynomial over a sample."""
        return input_degree(self.model, self.interpolation)

    @property
    def description(self) -> dict[str, Any]:
        """As JSON can hold it. The paper's equation goes without saying, as it does in what was stored first."""
        told = {f.name: getattr(self, f.name) for f in fields(self) if f.name not in ("model", "interpolation")}
        if self.model == difference():
            return told
        return told | {"model": self.model.digest, "interpolation": self.interpolation}

    @property
    def path(self) -> Path:
        """The file in the package that holds this task's oracle."""
        digest = hashlib.sha256(json.dumps(self.description).encode()).hexdigest()[:12]
        return FOLDER / f"{self.samples}-samples-{digest}.npz"


@dataclass(frozen=True)
class Systems:
    """The systems of a task, by row.

    Attributes:
        task: what is asked of them.
        theta: (n, K) their coefficients.
        precision: (K, K) Λ0.
    """

    task: Task
    theta: FloatArray
    precision: FloatArray

    @classmethod
    def of(cls, env_id: str, count: int, options: dict[str, Any] | None = None) -> Systems:
        """The first systems of a track, as they are evaluated with seed 0."""
        envs = make(env_id, count, options)
        envs.reset(seed=0)
        task, plant = Task.of(envs), plant_of(envs.experiment)
        precision = np.linalg.inv(plant.prior.coefficients_cov).astype(np.float64)
        return cls(task, plant.coefficients_of(envs.truth), precision)

    def known(self, row: int) -> Known:
        """What the worth of an input to one system is taken at."""
        return Known(self.theta[row].copy(), self.precision, self.task.noises)

    def worth(self, inputs: npt.ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Worth ½ log det(Λ0 + F) [nats], and peak displacement without noise [V], of inputs (n, samples) [V].

        Each (n,). Inputs that are not finite, as after the end of an episode, tell nothing from there on.
        """
        u = np.array(inputs, dtype=np.float64)
        if u.ndim != 2 or len(u) > len(self.theta):
            raise ValueError(f"inputs must have shape (n, samples) with n <= {len(self.theta)}, but have {u.shape}")
        values, peaks = np.empty((2, len(u)))
        t = self.task
        appraise = climber(t.model, t.degree).appraise
        appraise(self.theta, self.precision, t.noises, t.max_output, u, values, peaks)
        return values, peaks
