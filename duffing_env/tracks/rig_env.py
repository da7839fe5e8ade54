"""A rig as an environment: simulated from the rig's guess, or around a real plant."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar

import numpy as np

from duffing_env.env import DuffingEnv
from duffing_env.env_common import ReadOnlyOption
from duffing_env.experiment_config import Experiment, SimulatedExperiment
from duffing_env.input_options import ByInput
from duffing_env.tracks.external_plant_env import (
    ONE_PLANT_MESSAGE,
    Plant,
    RigLike,
    RigPlantEnv,
    RigScaling,
    playable_rig,
)
from duffing_env.vector_env import DuffingVectorEnv
from estimator.belief import Belief
from estimator.inference.noise_grid import NoiseGridSize
from estimator.models.model import Model
from estimator.rigs.rig_prior import NOISE_STD_FRACTION, OFFSET_STD_FRACTION, STDS_PER_90_PERCENT, rig_prior
from estimator.support.array_types import FloatArray


@dataclass(frozen=True)
class RigExperiment(RigScaling, SimulatedExperiment):
    """An experiment on oscillators drawn from a rig's guess. All numbers are in parts of the rig's limit and range.

    `RigEnv` describes its options; ``spread``, ``plant_spread``, ``jump``, ``mean`` and ``prior`` are refused, because
    the guess gives the range.
    """

    rig: RigLike | None = None
    max_input: ByInput = 1.0
    max_output: float = 1.0
    process_noise: float | None = None  # type: ignore[assignment]
    measurement_noise: float | None = None  # type: ignore[assignment]
    noise_range: float = 10.0
    noise_hypotheses: NoiseGridSize = (5, 5)

    def __post_init__(self) -> None:
        if not isinstance(self.factorisation, str) or self.factorisation != "structured":
            raise ValueError(f"factorisation must be 'structured' for a rig, but is {self.factorisation!r}")
        rig = playable_rig(self.rig)
        object.__setattr__(self, "rig", rig)
        for name, channel, scale in (
            ("process_noise", rig.only_input, rig.scales.input),
            ("measurement_noise", rig.output, rig.scales.output),
        ):
            if getattr(self, name) is None:
                object.__setattr__(self, name, NOISE_STD_FRACTION if channel.noise is None else channel.noise / scale)
        super().__post_init__()
        self._check_fractions()
        for name, usual in (("spread", 0.3), ("plant_spread", None), ("jump", 0.0), ("mean", None), ("prior", None)):
            if getattr(self, name) != usual:
                raise ValueError(f"{name} must be left out for a rig, whose guess gives the range")

    @property
    def plant(self) -> Model:
        """Eq. (1) with offsets, measured by the rig's sensor."""
        return self.validated_rig.model

    @property
    def model(self) -> Model:
        """The plant's model."""
        return self.plant

    @property
    def nominal_parameters(self) -> dict[str, float]:
        """The middle of the guess, in internal units."""
        return {name: mean for name, (mean, _) in self._parameter_moments.items()}

    @cached_property
    def _parameter_moments(self) -> dict[str, tuple[float, float]]:
        """Parameter to middle and standard deviation, in internal units; of the log-normal m, minus its logarithm's."""
        rig, model, scales = self.validated_rig, self.plant, self.scales
        assert rig.guess is not None
        outside = {
            name: ((low + high) / 2, (high - low) / 2 / STDS_PER_90_PERCENT) for name, (low, high) in rig.guess.items()
        }
        low, high = rig.guess["m"]
        outside |= {
            "u0": (rig.only_input.offset, OFFSET_STD_FRACTION * scales.input),
            "y0": (rig.output.offset, OFFSET_STD_FRACTION * scales.output),
        }
        inside = {}
        for name in model.physical:
            scale = scales.factor(model.dimensions[name])
            inside[name] = outside[name][0] / scale, outside[name][1] / scale
        scale = scales.factor(model.dimensions["m"])
        inside["m"] = float(np.sqrt(low * high)) / scale, -float(np.log(high / low)) / 2 / STDS_PER_90_PERCENT
        return inside

    @cached_property
    def prior_belief(self) -> Belief:
        """The prior from the guess, with the noise priors at the guessed noises."""
        prior, (process, sensor) = rig_prior(self.validated_rig), self.prior_noise_stds
        process_std, shape = _process_noise_std(process, prior.coefficients()["gain"][0]), float(self.noise_shape)
        gamma, xi = ((shape, shape * std**2) for std in (process_std, sensor))
        return Belief.of(prior.model, prior.mean, prior.cov, gamma, xi, scales=prior.scales)

    def prior_for_model(self, model: Model, factorisation: str = "structured") -> Belief:
        """The prior of the rig's model; no other model has the rig's offsets.

        Raises:
            ValueError: for another model.
        """
        if model != self.model:
            raise ValueError(f"model must be the rig's, but is {model.name!r}")
        return self.prior_belief.with_factorisation(factorisation)

    @property
    def plant_params(self) -> dict[str, Any]:
        """The noises and the range of the plants, in internal units."""
        plant_fields, gain = super().plant_params, self.prior_belief.coefficients()["gain"][0]
        stds: FloatArray = np.array([std for _, std in self._parameter_moments.values()])
        return {
            **plant_fields,
            "process_noise": _process_noise_std(plant_fields["process_noise"], gain),
            "parameter_stds": stds,
        }


def _process_noise_std(disturbance: float, gain: float) -> float:
    """Standard deviation σ_w of the process noise from a disturbance of the force (`estimator.rigs.rig_prior`)."""
    return float(disturbance * gain / np.sqrt(3))


class RigEnv(DuffingEnv):
    r"""Choose the input of an oscillator on a given rig so that its parameters are identified.

    ## Description

    An `estimator.Rig` describes the set-up of an oscillator m x'' + c x' + a x + b x³ = u + w: sampling step, units,
    limit of the input, range and kind of the sensor, and a guess of m, c, a and b. The environment draws oscillators
    from the guess, with offsets of input and output and noises unknown to estimator and policy, and simulates the
    differential equation. ``plant=`` replaces the simulation by a real plant (`duffing_env.tracks.external_plant_env`).

    Internal numbers are in parts of the input's limit and the output's range; ``belief`` and ``truth`` are in the rig's
    units.

    ## Action space

    `Box(-1, 1, (1,), float32)`, the input in parts of ``max_input`` times the rig's limit.

    ## Observation space

    `Box(35, float32)`, every entry clipped to its bounds: for the six coefficients of Eq. (1) with offsets, posterior
    means (deviation from the prior's, in its standard deviations), logarithms of their standard deviations relative to
    the prior's, 15 correlations, log E[γ] and log E[ξ] relative to the prior's, two states, the last input and output,
    the time and the energy that are left, in the order of `duffing_env.storage.kernel_spec.observation_bounds`.

    ## Reward

    As `DuffingEnv`; with ``plant=`` only the rewards that do not need the truth.

    ## Starting state

    Simulated: m is drawn log-normally, c, a and b from a Gaussian whose central 90 % are the guess (a parameter with
    one sign in the guess keeps it), offsets of 3 % and noises over a decade; the oscillator is at rest. With
    ``plant=``: the state after ``plant.reset()``.

    ## Episode end

    Terminated when the output leaves the range (times ``max_output``), or at a number that is not finite; truncated
    after ``horizon`` samples.

    ## Information

    As `DuffingEnv`; with ``plant=`` as `duffing_env.tracks.external_plant_env.RigPlantEnv`.

    ## Arguments

    As `DuffingEnv` except for ``spread``, ``plant_spread``, ``jump``, ``mean`` and ``prior``, and:

    | Argument | Default | Meaning |
    |----------|---------|---------|
    | ``rig`` | | a `Rig`, a dictionary (which is JSON-able), or the name of a rig file; with limit, range and guess |
    | ``plant`` | None | a real plant: an object with ``reset()`` and ``step(u)``, in the rig's units |
    | ``max_input`` | 1 | input of the action 1, in parts of the rig's limit; at most 1 |
    | ``max_output`` | 1 | largest output, in parts of the rig's range; at most 1 |
    | ``process_noise`` | the rig's, or 0.001 | disturbance of the force in a sample, in parts of the input's limit |
    | ``measurement_noise`` | the rig's, or 0.001 | noise of the sensor, in parts of the output's range |
    | ``noise_range`` | 10 | factor over which both noises are drawn for every episode |
    | ``noise_hypotheses`` | (5, 5), or (7, 7) with ``plant`` | values of each noise that the estimator weighs |

    >>> import gymnasium as gym
    >>> import duffing_env
    >>> from estimator import Channel, Rig
    >>> guess = {"m": (0.3, 0.5), "c": (0.4, 0.8), "a": (2e3, 3e3), "b": (2e7, 6e7)}
    >>> rig = Rig(1e-3, input=Channel("N", limit=6), output=Channel("m", range=0.03, noise=5e-6), guess=guess)
    >>> env = gym.make("duffing_env/Rig-v0", rig=rig)
    >>> observation, info = env.reset(seed=0)
    >>> done = False
    >>> while not done:
    ...     action = [1.0 if observation[32] <= 0 else -1.0]
    ...     observation, reward, terminated, truncated, info = env.step(action)
    ...     done = terminated or truncated
    >>> m, std, unit = env.unwrapped.belief.parameters()["m"]
    >>> bool(abs(m - env.unwrapped.truth.m) < 4 * std), unit
    (True, 'kg')

    ## Version history

    * v0: initial version
    """

    experiment_class: ClassVar[type[Experiment]] = RigExperiment

    plant = ReadOnlyOption("plant", "_plant")
    _plant: ClassVar[None] = None

    def __new__(cls, plant: Plant | None = None, **options: Any) -> Any:
        """A `RigEnv`, or around a plant a `RigPlantEnv`."""
        return super().__new__(cls) if plant is None else RigPlantEnv(plant, **options)


class RigVectorEnv(DuffingVectorEnv):
    """Many `RigEnv` at once."""

    single_env_class: ClassVar[type[DuffingEnv]] = RigEnv

    def __init__(self, num_envs: int = 1, *, plant: Plant | None = None, **options: Any) -> None:
        if plant is not None:
            raise ValueError(f"plant must be left out of make_vec: {ONE_PLANT_MESSAGE}")
        super().__init__(num_envs, **options)
