"""The vector environments of a training run: a track, a track with drawn options, or the family of oscillators."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np

from agents.evaluation.track_batch import make_track_batch
from agents.sb3_vec_env import DuffingVecEnv
from agents.track_ids import RIG_TRACK
from agents.training.environments import oscillator_family
from agents.training.environments.feature_vec_env import FeatureVecEnv
from agents.training.environments.randomised_vec_env import DrawOptions, MixedVecEnv, TrackOptions, draw_track_options
from agents.training.training_config import INFORMATION_REWARDS, TrainConfig
from estimator.models.single_input import check_single_input

#: Environments in which random actions are played to fit the normaliser of the features.
N_NORMALISER_ENVS = 64


def make_training_envs(config: TrainConfig, seed: int) -> DuffingVecEnv | FeatureVecEnv | MixedVecEnv:
    """The environments of a run, with features where its hyperparameters ask for them.

    Args:
        config: of the run, whose own seed the normaliser of the features is fitted with.
        seed: of the environments.

    Raises:
        ValueError: for a track with several inputs.
    """
    n = config.hyperparameters.num_envs
    if not config.hyperparameters.features:
        levels = getattr(config.hyperparameters, "levels", 0)
        envs = DuffingVecEnv(config.env, n, seed=seed, levels=levels, **_options(config))
        check_single_input(
            "a trained policy", envs.envs.unwrapped.experiment.model,
            "train with Stable-Baselines3 on agents.sb3_vec_env.DuffingVecEnv, and pass the model to make_policy",
        )  # fmt: skip
        return envs
    feature_envs, samples = _feature_envs(config, n, seed)
    normaliser_envs, _ = _feature_envs(config, N_NORMALISER_ENVS, config.seed)
    feature_envs.normalizer.fit(normaliser_envs, samples, config.seed)
    return feature_envs


def _options(config: TrainConfig) -> dict[str, Any]:
    return {"reward": config.reward, **config.options}


def _feature_envs(config: TrainConfig, num_envs: int, seed: int) -> tuple[FeatureVecEnv | MixedVecEnv, int]:
    """Environments whose observations are features, and the number of samples of an episode."""
    if config.env == oscillator_family.FAMILY:
        envs = _mixed_envs(config, num_envs, seed, draw_family_options, raw_observation=False)
        return envs, oscillator_family.TYPICAL_SAMPLES
    if config.vary:
        return _varied_envs(config, num_envs, seed)
    return _track_envs(config, num_envs, seed)


def draw_family_options(rng: np.random.Generator) -> TrackOptions:
    """Draw a rig of the family, as `DrawOptions`."""
    return TrackOptions(RIG_TRACK, oscillator_family.draw_oscillator(rng).options)


def _mixed_envs(
    config: TrainConfig, num_envs: int, seed: int, draw: DrawOptions, *, raw_observation: bool
) -> MixedVecEnv:
    levels = getattr(config.hyperparameters, "levels", 0)
    return MixedVecEnv(num_envs, seed, draw, reward=config.reward, levels=levels, raw_observation=raw_observation)


def _varied_envs(config: TrainConfig, num_envs: int, seed: int) -> tuple[MixedVecEnv, int]:
    """A track with options that are drawn for every episode; a value that the track refuses is refused here."""
    for name, bound in ((name, end) for name, bounds in config.vary.items() for end in bounds):
        checked_envs = make_track_batch(config.env, 1, _options(config) | {name: bound})
        checked_envs.close()
    draw = partial(draw_track_options, env_id=config.env, options=config.options, ranges=config.vary)
    envs = _mixed_envs(config, num_envs, seed, draw, raw_observation=config.hyperparameters.own)
    return envs, checked_envs.horizon


def _track_envs(config: TrainConfig, num_envs: int, seed: int) -> tuple[FeatureVecEnv, int]:
    """A track as it is."""
    envs = DuffingVecEnv(config.env, num_envs, seed=seed, **_options(config))
    feature_envs = FeatureVecEnv(
        envs,
        raw_observation=config.hyperparameters.own,
        levels=getattr(config.hyperparameters, "levels", 0),
        reward_in_nats=config.reward in INFORMATION_REWARDS,
    )
    return feature_envs, int(envs.envs.unwrapped.experiment.samples)
