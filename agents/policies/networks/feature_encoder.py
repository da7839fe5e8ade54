"""Feature encoder of trained policies: observations become network features and the shield's allowed actions."""

from __future__ import annotations

from functools import cache
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from agents.planning.model_probe import ModelView, observation_layout, planning_limit
from agents.planning.time_scales import kept_accumulated_noise, probe_time_scales
from agents.policies.networks.feature_names import FEATURE_NAMES
from agents.policies.networks.rollout_features import compile_features
from estimator.compilation.simd import kernel
from estimator.models.model import Model
from estimator.models.single_input import check_single_input
from estimator.support.argument_checks import short_repr
from estimator.support.array_types import FloatArray

#: Predictive standard deviations that the shield keeps from the limit where the noises are known.
MARGIN_KNOWN_NOISE = 8.0

#: The same where the noises are believed only.
MARGIN_UNKNOWN_NOISE = 10.0

#: Change of an oscillation's height per sample by a push, in parts of it, where the energy is limited: pushes in
#: proportion to the motion take least energy.
AMPLITUDE_GROWTH = 0.15

#: Largest values of settings, in samples.
_MAX_SETTINGS = {"samples": 1e9, "hold_samples": 1e3}

#: Settings that may be 0.
_MAY_BE_ZERO = ("information_rate", "process_variance", "sensor_variance", "accumulated_noise", "margin")


class FeatureSettings(NamedTuple):
    """References of observations, and the limits of an episode.

    Attributes:
        center: (K,) prior means of the coefficients.
        std: (K,) their standard deviations.
        information_rate: (K, K) information about the coefficients per sample of an oscillation at the limit, times the
            variance of an output.
        scales: (n,) sizes of the states when the first sensor is at its limit.
        max_input: amplitude limit.
        max_output: limit that observations of the first sensor are relative to.
        limit: of the shield.
        samples: of an episode.
        energy: limit of Σ u²; inf for none.
        process_variance: reference of the observation's log E[γ].
        sensor_variance: reference of the first sensor's log E[ξ].
        accumulated_noise: variance by which process noise moves the first sensor before an input can correct it, in
            parts of its variance per sample.
        hold_samples: samples of a move.
        margin: predictive standard deviations that the shield keeps from the limit.
        step_response: change of the first sensor's output by the largest input over a sample from rest, in parts of the
            limit.
        amplitude_growth: where the energy is limited, the change of an oscillation's height by a push, per sample and
            in parts of the height; a push is at least as large as the remaining energy lasts for.
    """

    center: FloatArray
    std: FloatArray
    information_rate: FloatArray
    scales: FloatArray
    max_input: float
    max_output: float
    limit: float
    samples: float
    energy: float
    process_variance: float
    sensor_variance: float
    accumulated_noise: float
    hold_samples: float
    margin: float
    step_response: float
    amplitude_growth: float


class ShieldedFeatures(NamedTuple):
    """Features of n observations, and the shield.

    Attributes:
        values: (n, features) float32 inputs of a network: finite, and at most
            `agents.policies.networks.feature_names.MAX_FEATURE` in size.
        mirror_signs: (n,) float32, -1 where the observation was mirrored.
        allowed_intervals: (n, 2) float32 lowest and highest action that the shield allows, before mirroring.
        action_scales: (n,) float32 action for a choice of 1, before mirroring: 1, or less where energy is scarce.
        remaining_information: (n,) float32 expected information of the rest, ½ log det(I + C J) [nats].
    """

    values: npt.NDArray[np.float32]
    mirror_signs: npt.NDArray[np.float32]
    allowed_intervals: npt.NDArray[np.float32]
    action_scales: npt.NDArray[np.float32]
    remaining_information: npt.NDArray[np.float32]

    def to_actions(self, choices: npt.ArrayLike) -> npt.NDArray[np.float32]:
        """Actions (n, 1) for choices (n,) in [-1, 1] of a network: the nearest allowed ones, mirrored back."""
        lowest, highest = self.allowed_intervals.T
        kept = np.minimum(np.maximum(np.asarray(choices, dtype=np.float32), lowest), highest)
        return (kept * self.action_scales * self.mirror_signs)[:, None]


@cache
def _compile_feature_batch(view: ModelView) -> Any:
    """``encode_batch(observations, setting, with_observation, *features)`` fills in `ShieldedFeatures`."""
    workspace, encode = compile_features(view)

    @kernel(variant=view.compile_key)
    def encode_batch(
        observations,
        setting,
        with_observation,
        values,
        mirror_signs,
        allowed_intervals,
        action_scales,
        remaining_information,
    ):
        work = workspace()
        for i in range(len(observations)):
            mirror_signs[i], action_scales[i], remaining_information[i] = encode(
                observations[i], setting, with_observation, work, values[i], allowed_intervals[i]
            )

    return encode_batch


class FeatureEncoder:
    """Turns observations of an environment into `ShieldedFeatures`.

    Args:
        setting: references and limits.
        view: of the believed model.
        with_observation: whether the observation follows the features.
    """

    def __init__(self, setting: FeatureSettings, view: ModelView, *, with_observation: bool = True) -> None:
        self.setting, self.model_view, self.with_observation = setting, view, with_observation

    @classmethod
    def of(cls, env: Any, *, with_observation: bool = True) -> FeatureEncoder:
        """The encoder for an unwrapped environment, single or vector.

        Raises:
            ValueError: for an environment that is not one of duffing_env, shows another observation than the
                posterior, holds its actions for several samples, or has several inputs.
        """
        experiment = getattr(env, "experiment", None)
        if experiment is None:
            raise ValueError(
                f"env must be one of duffing_env for a policy with features, but is {type(env).__name__}; pass that one"
            )
        if experiment.observation != "posterior":
            raise ValueError(
                f"env must show the observation 'posterior' for features, but shows "
                f"{short_repr(experiment.observation)}; leave out the option observation"
            )
        if experiment.hold != 1:
            raise ValueError(f"hold must be 1 for features, but is {experiment.hold}; train without features")
        check_single_input("features", experiment.model, "choose a signal such as prbs")
        setup, view, prior = experiment.kernel_params, ModelView.of(experiment), experiment.prior_belief
        center = prior.coefficients_mean
        max_input = float(setup.max_input[0])
        time_scales = probe_time_scales(view, center, max_input, setup.max_output)
        setting = FeatureSettings(
            center=center,
            std=1.0 / setup.prior_inverse_std,
            information_rate=time_scales.mean_information,
            scales=time_scales.scales,
            max_input=max_input,
            max_output=float(setup.max_output),
            limit=planning_limit(experiment, time_scales.scales),
            samples=float(setup.horizon),
            energy=float(setup.budget),
            process_variance=float(np.exp(-setup.prior_log_precisions[0])),
            sensor_variance=float(np.exp(-setup.prior_log_precisions[1])),
            accumulated_noise=kept_accumulated_noise(experiment, time_scales),
            hold_samples=float(time_scales.hold_samples),
            margin=MARGIN_KNOWN_NOISE if experiment.noise_hypotheses == 1 else MARGIN_UNKNOWN_NOISE,
            step_response=abs(time_scales.step_response) * max_input / float(setup.max_output),
            amplitude_growth=AMPLITUDE_GROWTH,
        )
        return cls(setting, view, with_observation=with_observation)

    @classmethod
    def from_tensor(cls, numbers: npt.ArrayLike, description: dict[str, Any]) -> FeatureEncoder:
        """The encoder of a `to_tensor` and a `describe`.

        Raises:
            ValueError: for another count of numbers, or numbers out of range.
        """
        described = dict(description)
        with_observation, view = bool(described.pop("own")), ModelView(Model(**described.pop("model")), **described)
        k, n = view.model.n_coefficients, view.model.n_states
        flat = np.asarray(numbers, dtype=np.float64)
        sizes = (k, k, k * k, n)
        size = sum(sizes) + len(FeatureSettings._fields) - len(sizes)
        if flat.shape != (size,):
            raise ValueError(f"setting must be {size} numbers, but is {flat.tolist()!r:.200}")
        center, std, rate, scales, others = np.split(flat, np.cumsum(sizes))
        setting = FeatureSettings(center, std, rate.reshape(k, k), scales, *others.tolist())
        value: Any
        for name, value in zip(FeatureSettings._fields, setting, strict=True):
            to_check = np.diag(value) if name == "information_rate" else np.asarray(value)
            sound = np.isfinite(value).all() or (name == "energy" and value == np.inf)
            sound &= bool(name == "center" or (to_check > 0).all() or (name in _MAY_BE_ZERO and (to_check >= 0).all()))
            if not sound or (name in _MAX_SETTINGS and not 1 <= value <= _MAX_SETTINGS[name]):
                raise ValueError(f"{name} of setting must be positive and finite, but is {value!r:.80}; copy it anew")
        return cls(setting, view, with_observation=with_observation)

    def to_tensor(self) -> FloatArray:
        """The setting as a flat array, for a policy's file."""
        return np.concatenate([np.ravel(np.asarray(value, dtype=np.float64)) for value in self.setting])

    def describe(self) -> dict[str, Any]:
        """The rest of the encoder, as JSON can hold it."""
        return {
            "own": self.with_observation,
            "model": self.model_view.model.to_dict(),
            "degree": self.model_view.degree,
            "lag": self.model_view.lag,
        }

    @property
    def observation_size(self) -> int:
        """Entries of the observations."""
        return observation_layout(self.model_view.model).size

    @property
    def size(self) -> int:
        """Number of features."""
        return len(FEATURE_NAMES) + self.with_observation * self.observation_size

    def __call__(self, observations: npt.ArrayLike) -> ShieldedFeatures:
        """The features of observations (n, entries)."""
        float_observations = np.ascontiguousarray(observations, dtype=np.float32)
        n = len(float_observations)
        found = ShieldedFeatures(*(np.empty(shape, dtype=np.float32) for shape in ((n, self.size), n, (n, 2), n, n)))
        _compile_feature_batch(self.model_view)(float_observations, self.setting, self.with_observation, *found)
        return found
