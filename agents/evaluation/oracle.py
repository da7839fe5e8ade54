"""Oracle of a track: stored D-optimal inputs at the true parameters of its first systems, for D-efficiency.

`research.oracles.oracle_search` finds them. The criterion has many local maxima, so the best input found is only a
lower bound, and a better one replaces it.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass, replace
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from agents.evaluation.plant_model import PlantModel, plant_model_of
from agents.evaluation.track_batch import TEST_OPTIONS, make_track_batch
from agents.planning.d_optimality import NominalSystem
from agents.planning.projected_gradient import DesignLimits, compile_projected_gradient
from duffing_env.experiment_config import SimulatedExperiment
from estimator.engine.input_hold import input_degree
from estimator.inference.fisher_information import fisher_information
from estimator.inference.record_filter import noise_variances
from estimator.models.difference_equation import difference
from estimator.support.array_types import FloatArray
from estimator.support.file_io import write_atomically

ORACLE_FOLDER = Path(__file__).parents[1] / "oracles"

#: Inputs are stored as whole numbers; this one is the largest input.
QUANTISATION_LEVELS = 32767


@dataclass(frozen=True)
class TrackSystems:
    """The first systems of a track, by row.

    Attributes:
        experiment: of the track.
        theta: (n, K) coefficients of the systems.
        precision: (K, K) Λ0.
        variances: (n, 1 + p) of the process noise and of each sensor's.
    """

    experiment: SimulatedExperiment
    theta: FloatArray
    precision: FloatArray
    variances: FloatArray

    @classmethod
    def of(cls, env_id: str, n_systems: int, options: dict[str, Any] | None = None) -> TrackSystems:
        """The first systems of a track, as they are evaluated with seed 0: of the branch ``test`` by default.

        Raises:
            ValueError: where its plant is not simulated, or changes.
        """
        envs = make_track_batch(env_id, n_systems, TEST_OPTIONS | (options or {}))
        envs.reset(seed=0)
        experiment = envs.experiment
        if not isinstance(experiment, SimulatedExperiment) or experiment.jump or experiment.max_slew is not None:
            raise ValueError(
                f"env must simulate a plant without jump and slew limit, but is {experiment}; choose another track"
            )
        plant = plant_model_of(experiment, envs.truth)
        precision = np.linalg.inv(plant.prior.coefficients_cov).astype(np.float64)
        variances = noise_variances(plant.model, plant.process_noise, plant.sensor_noises)
        variances = np.broadcast_to(variances, (n_systems, variances.shape[-1])).copy()
        return cls(experiment, plant.coefficients_of(envs.truth), precision, variances)

    def rows(self, first: int, stop: int) -> TrackSystems:
        """The systems of some rows."""
        chosen = slice(first, stop)
        return replace(self, theta=self.theta[chosen], variances=self.variances[chosen])

    @property
    def plant(self) -> PlantModel:
        """The model of the plant."""
        return plant_model_of(self.experiment)

    @property
    def samples(self) -> int:
        """Of an episode."""
        return self.experiment.samples

    @property
    def limits(self) -> DesignLimits:
        """Limits of the inputs of an episode."""
        experiment = self.experiment
        energy = np.inf if experiment.max_rms is None else experiment.max_rms**2 * experiment.samples
        return DesignLimits(experiment.max_output, experiment.max_output, float(experiment.max_inputs[0]), energy)

    @property
    def degree(self) -> int:
        """Of the input's polynomial over a sample."""
        return input_degree(self.plant.model, self.plant.interpolation)

    @property
    def description(self) -> dict[str, Any]:
        """Everything that the criterion of an input and its limits depend on.

        The model is left out where it is Eq. (2), so that the first stored oracles keep their names.
        """
        experiment, plant = self.experiment, self.plant
        option_names = ("max_input", "max_output", "samples", "process_noise", "measurement_noise", "spread")
        described = {name: getattr(experiment, name) for name in option_names}
        described |= {
            "plant_spread": experiment.spread if experiment.plant_spread is None else experiment.plant_spread,
            "max_rms": experiment.max_rms,
        }
        described["branch"] = experiment.branch
        if experiment.noise_range != 1:
            described["noise_range"] = experiment.noise_range
        if plant.model == difference():
            return described
        return described | {"model": plant.model.digest, "interpolation": plant.interpolation}

    @property
    def path(self) -> Path:
        """The file in the package that holds their oracle."""
        digest = hashlib.sha256(json.dumps(self.description).encode()).hexdigest()[:12]
        return ORACLE_FOLDER / f"{self.samples}-samples-{digest}.npz"

    def nominal_system(self, row: int) -> NominalSystem:
        """One system and its prior precision, for the criterion."""
        return NominalSystem(self.theta[row].copy(), self.precision, tuple(self.variances[row]))

    def criterion_and_peak(self, inputs: npt.ArrayLike) -> tuple[FloatArray, FloatArray]:
        """The criterion ½ log det(Λ0 + F) [nats], and peak displacement without noise [V], of inputs (n, samples) [V].

        Each (n,). Inputs that are not finite, as after the end of an episode, end there.
        """
        u = np.array(inputs, dtype=np.float64)
        if u.ndim != 2 or len(u) > len(self.theta):
            raise ValueError(f"inputs must have shape (n, samples) with n <= {len(self.theta)}, but have {u.shape}")
        values, peaks = np.empty((2, len(u)))
        evaluate_batch = compile_projected_gradient(self.plant.model, self.degree).evaluate_batch
        for row in range(len(u)):
            one = slice(row, row + 1)
            noises = tuple(self.variances[row])
            evaluate_batch(self.theta[one], self.precision, noises, self.limits.output, u[one], values[one], peaks[one])
        return values, peaks

    def information(self, inputs: npt.ArrayLike, outputs: npt.ArrayLike | None = None) -> FloatArray:
        """(n, K, K) F of inputs (n, samples) [V], along the outputs that followed, or the response without noise.

        Raises:
            ValueError: as `estimator.fisher_information`.
        """
        n, plant, stds = len(np.asarray(inputs)), self.plant, np.sqrt(self.variances)
        return fisher_information(
            plant.model, self.theta[:n], inputs, stds[:n, 0], stds[:n, 1:], y=outputs, interpolation=plant.interpolation
        )


@dataclass(frozen=True)
class Oracle:
    """The best inputs found so far.

    Attributes:
        systems: that they are for.
        inputs: (n, samples) [V].
        values: (n,) their criterion [nats].
        bounds: (n,) upper bounds of it over admissible inputs [nats] (`research.oracles.certificate`); NaN where none
            is stored.
    """

    systems: TrackSystems
    inputs: FloatArray
    values: FloatArray
    bounds: FloatArray

    @classmethod
    def of(cls, systems: TrackSystems) -> Oracle:
        """The stored oracle, of as many of the systems as it has.

        Raises:
            FileNotFoundError: if none is stored for them, saying which command makes one.
            ValueError: if it is for other systems.
        """
        path = systems.path
        if not path.is_file():
            raise FileNotFoundError(
                f"no oracle is stored for {systems.description}; from a checkout of the repository, run "
                "python -m research.oracles.oracle_search --env ..."
            )
        with np.load(path, allow_pickle=False) as stored:
            scaled, theta, bounds = stored["inputs"], stored["theta"], stored["bounds"]
            task = str(stored["task"])
        n = min(len(theta), len(systems.theta))
        if task != json.dumps(systems.description) or not np.allclose(theta[:n], systems.theta[:n], rtol=1e-9, atol=0):
            raise ValueError(f"oracle must be for the systems at hand, but {path.name} is not; make it anew")
        systems_with_oracle = systems.rows(0, n)
        inputs = systems.limits.amplitude * (scaled[:n] / QUANTISATION_LEVELS)
        return cls(systems_with_oracle, inputs, systems_with_oracle.criterion_and_peak(inputs)[0], bounds[:n])

    @staticmethod
    def count_stored(systems: TrackSystems) -> int:
        """The number of systems that an oracle is stored of."""
        if not systems.path.is_file():
            return 0
        with np.load(systems.path, allow_pickle=False) as stored:
            return len(stored["theta"])

    def head(self, count: int) -> Oracle:
        """The oracle of the first systems."""
        return Oracle(self.systems.rows(0, count), self.inputs[:count], self.values[:count], self.bounds[:count])

    def save(self) -> Path:
        """Store it in the package, in one piece."""
        content = BytesIO()
        np.savez_compressed(
            content,
            inputs=_to_int16(self.inputs / self.systems.limits.amplitude),
            theta=self.systems.theta,
            values=self.values,
            bounds=self.bounds,
            task=np.array(json.dumps(self.systems.description)),
        )
        write_atomically(self.systems.path, content.getvalue())
        return self.systems.path

    def efficiency(self, inputs: npt.ArrayLike, outputs: npt.ArrayLike) -> tuple[FloatArray, FloatArray]:
        """D-efficiency of an episode: exp[(log det(Λ0+F) - log det(Λ0+F_oracle)) / K] for K coefficients.

        F is taken at the true coefficients along the outputs that were seen, because feedback keeps these within
        their limit, and not the response without noise to the same inputs, which drifts away from them. 0.5 means that
        about twice the samples would be needed. Above 1 says that there is a better input than the stored one, or that
        the noise was kind.

        Args:
            inputs: (n, samples) [V]; NaN from the end of an episode on.
            outputs: (n, samples) [V] that followed them; (n, samples, sensors) of several.

        Returns:
            (n,) against the stored inputs, and (n,) against the bounds: at least so much of what is possible.

        Raises:
            ValueError: for more rows than the oracle has systems, or as `estimator.fisher_information`.
        """
        u = np.asarray(inputs, dtype=np.float64)
        if u.ndim != 2 or len(u) > len(self.values):
            raise ValueError(f"inputs must have shape (n, samples) with n <= {len(self.values)}, but have {u.shape}")
        information = self.systems.information(u, outputs)
        values = 0.5 * np.linalg.slogdet(self.systems.precision + information)[1]
        to_stored, to_bound = (
            np.exp(2 * (values - top[: len(u)]) / information.shape[-1]) for top in (self.values, self.bounds)
        )
        return to_stored, to_bound


def quantise(scaled: FloatArray) -> FloatArray:
    """Inputs in parts of the largest as they come back from the store, never larger than they were."""
    return _to_int16(scaled) / QUANTISATION_LEVELS


def _to_int16(scaled: FloatArray) -> npt.NDArray[np.int16]:
    # A little more, so that what was stored stays so.
    return np.trunc(scaled * (QUANTISATION_LEVELS * (1 + 1e-9))).astype(np.int16)
