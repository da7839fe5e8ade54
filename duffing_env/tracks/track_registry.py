"""The registered environments (tracks) with their options. Importing `duffing_env` registers them, which is fast."""

from __future__ import annotations

from typing import Any

from estimator.models.pendulum import PENDULUM_SAMPLING_STEP

#: Default limits of the Duffing oscillator's tracks.
_DUFFING_LIMITS = {"horizon": 256, "max_input": 0.15, "max_output": 0.6}

#: On Eq. (1) both noises are drawn for every episode, over a decade each, and neither agent nor estimator gets them.
_UNKNOWN_NOISES = {"noise_range": 10.0, "noise_hypotheses": 7}

#: The pendulum of IO-SMC²: angle and velocity are measured without noise (here 1 µrad), every 0.05 s.
_PENDULUM_OPTIONS = {
    "mean": {"p1": 14.7, "p2": 0.0, "p3": 3.0},
    "std": {"p1": 0.1**0.5, "p2": 0.1, "p3": 0.1**0.5},
    "sampling_step": PENDULUM_SAMPLING_STEP,
    "measurement_noise": 1e-6,
    "noise_shape": 1e6,
    "horizon": 50,
    "max_input": 1.0,
}


def _registration(entry_point: str, vector_entry_point: str, **kwargs: Any) -> dict[str, Any]:
    """The keyword arguments with which a track is registered."""
    entry_points = {
        "entry_point": f"duffing_env.{entry_point}",
        "vector_entry_point": f"duffing_env.{vector_entry_point}",
    }
    return {**entry_points, "kwargs": kwargs}


def _difference_track(entry_point: str, **overrides: Any) -> dict[str, Any]:
    """A track on the paper's equation, with the options that differ from Amplitude-v0."""
    return _registration(entry_point, "vector_env:DuffingVectorEnv", **{**_DUFFING_LIMITS, **overrides})


def _continuous_track(env_class: str, **overrides: Any) -> dict[str, Any]:
    """A track on the differential equation, with the options that differ from Amplitude-v1."""
    vector_entry_point = "tracks.differential_equation_tracks:ContinuousVectorEnv"
    return _registration(
        f"tracks.differential_equation_tracks:{env_class}",
        vector_entry_point,
        **{**_DUFFING_LIMITS, **overrides, **_UNKNOWN_NOISES},
    )


def _model_track(system: str, **kwargs: Any) -> dict[str, Any]:
    """A track of any model."""
    return _registration("tracks.model_env:ModelEnv", "tracks.model_env:ModelVectorEnv", system=system, **kwargs)


#: Id of a track to its registration. Any change of numbers or spaces is a new version. No track registers
#: ``max_episode_steps``: its time limit would truncate a longer ``horizon`` (`duffing_env.env_common.ExperimentEnv`).
TRACKS: dict[str, dict[str, Any]] = {
    "duffing_env/Amplitude-v0": _difference_track("env:DuffingEnv"),
    "duffing_env/Short-v0": _difference_track("tracks.difference_equation_tracks:ShortEnv", horizon=48),
    "duffing_env/Power-v0": _difference_track("tracks.difference_equation_tracks:PowerEnv", max_rms=0.0222),
    "duffing_env/Output-v0": _difference_track("tracks.difference_equation_tracks:OutputEnv", max_output=0.3),
    "duffing_env/Drift-v0": _difference_track(
        "tracks.difference_equation_tracks:DriftEnv", horizon=512, jump=0.3, drift=0.01
    ),
    "duffing_env/Amplitude-v1": _continuous_track("ContinuousEnv"),
    "duffing_env/Short-v1": _continuous_track("ContinuousShortEnv", horizon=48),
    "duffing_env/Power-v1": _continuous_track("ContinuousPowerEnv", max_rms=0.0222),
    "duffing_env/Output-v1": _continuous_track("ContinuousOutputEnv", max_output=0.3),
    # Diffusion 0.1 of q'' as the standard deviation of its effect on q in a sample: 0.1 δ^1.5 / √3 [rad].
    "duffing_env/Pendulum-v0": _model_track(
        "pendulum", **_PENDULUM_OPTIONS, process_noise=6.454972e-4, max_output=6.283185307179586
    ),
    # By Euler's rule, as published: the effect of a sample on the velocity, δ √(0.1² δ + 1e-8) [rad per sample].
    "duffing_env/Pendulum-v1": _model_track(
        "pendulum_map", **_PENDULUM_OPTIONS, process_noise=1.1180452e-3, max_output=4.0
    ),
    "duffing_env/WienerHammerstein-v0": _model_track(
        "wiener_hammerstein",
        mean={"stiffness": 0.5, "damping": 0.15, "cubic": 1.0, "decay": 0.4},
        process_noise=1e-3,
        measurement_noise=1e-3,
        horizon=256,
        max_input=1.0,
        max_output=20.0,
    ),
    "duffing_env/Rig-v0": _registration("tracks.rig_env:RigEnv", "tracks.rig_env:RigVectorEnv", horizon=256),
    "duffing_env/SilverboxReplay-v0": _registration(
        "tracks.silverbox_replay:SilverboxReplayEnv",
        "tracks.silverbox_replay:SilverboxReplayVectorEnv",
        regime="multisine",
    ),
}


def register_tracks() -> None:
    """Register every track with Gymnasium that is not registered yet."""
    from gymnasium.envs.registration import register, registry

    for track_id, spec in TRACKS.items():
        if track_id not in registry:
            register(track_id, **spec)
            # Gymnasium calls all but the highest version of a name out of date. Here v0 is the paper's equation and v1
            # the differential equation, so the version is part of the name.
            registry[track_id].name = track_id.removeprefix("duffing_env/")
