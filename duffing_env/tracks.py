"""The registered environments. Importing `duffing_env` registers them; it is light, as every worker process does so."""

from __future__ import annotations

import warnings
from typing import Any

from estimator.models.pendulum import STEP

#: On Eq. (1) the noises are drawn for every episode, over a decade each, and known to nobody.
_UNKNOWN = {"noise_range": 10.0, "noise_hypotheses": 7}

#: The pendulum of IO-SMC²: angle and velocity are seen without noise (here 1 µrad), every 0.05 s.
_PENDULUM = {
    "mean": {"p1": 14.7, "p2": 0.0, "p3": 3.0},
    "std": {"p1": 0.1**0.5, "p2": 0.1, "p3": 0.1**0.5},
    "sampling_step": STEP,
    "measurement_noise": 1e-6,
    "noise_shape": 1e6,
    "horizon": 50,
    "max_input": 1.0,
}

#: Id of a track to what it is registered with. Any change of numbers or spaces is a new version. None registers
#: ``max_episode_steps``: its time limit would cut a longer ``horizon`` short (`duffing_env.env.Specified`).
TRACKS: dict[str, dict[str, Any]] = {
    "duffing_env/Amplitude-v0": {
        "entry_point": "duffing_env.env:DuffingEnv",
        "vector_entry_point": "duffing_env.vector_env:DuffingVectorEnv",
        "kwargs": {"horizon": 256, "max_input": 0.15, "max_output": 0.6},
    },
    "duffing_env/Short-v0": {
        "entry_point": "duffing_env.limited:ShortEnv",
        "vector_entry_point": "duffing_env.vector_env:DuffingVectorEnv",
        "kwargs": {"horizon": 48, "max_input": 0.15, "max_output": 0.6},
    },
    "duffing_env/Power-v0": {
        "entry_point": "duffing_env.limited:PowerEnv",
        "vector_entry_point": "duffing_env.vector_env:DuffingVectorEnv",
        "kwargs": {"horizon": 256, "max_input": 0.15, "max_output": 0.6, "max_rms": 0.0222},
    },
    "duffing_env/Output-v0": {
        "entry_point": "duffing_env.limited:OutputEnv",
        "vector_entry_point": "duffing_env.vector_env:DuffingVectorEnv",
        "kwargs": {"horizon": 256, "max_input": 0.15, "max_output": 0.3},
    },
    "duffing_env/Drift-v0": {
        "entry_point": "duffing_env.limited:DriftEnv",
        "vector_entry_point": "duffing_env.vector_env:DuffingVectorEnv",
        "kwargs": {"horizon": 512, "max_input": 0.15, "max_output": 0.6, "jump": 0.3, "drift": 0.01},
    },
    **{
        f"duffing_env/{name}-v1": {
            "entry_point": f"duffing_env.continuous:{entry}",
            "vector_entry_point": "duffing_env.vector_env:ContinuousVectorEnv",
            "kwargs": {"horizon": 256, "max_input": 0.15, "max_output": 0.6, **limits, **_UNKNOWN},
        }
        for name, entry, limits in (
            ("Amplitude", "ContinuousEnv", {}),
            ("Short", "ContinuousShortEnv", {"horizon": 48}),
            ("Power", "ContinuousPowerEnv", {"max_rms": 0.0222}),
            ("Output", "ContinuousOutputEnv", {"max_output": 0.3}),
        )
    },
    **{
        f"duffing_env/Pendulum-{version}": {
            "entry_point": "duffing_env.model_env:ModelEnv",
            "vector_entry_point": "duffing_env.model_env:ModelVectorEnv",
            "kwargs": {"system": system, **_PENDULUM, "process_noise": process_noise, "max_output": limit},
        }
        for version, system, process_noise, limit in (
            # Diffusion 0.1 of q'', counted as what a sample of it does to q: 0.1 δ^1.5 / √3.
            ("v0", "pendulum", 6.454972e-4, 6.283185307179586),
            # By Euler's rule, as published: what a sample does to the velocity in rad per sample, δ √(0.1² δ + 1e-8).
            ("v1", "pendulum_map", 1.1180452e-3, 4.0),
        )
    },
    "duffing_env/WienerHammerstein-v0": {
        "entry_point": "duffing_env.model_env:ModelEnv",
        "vector_entry_point": "duffing_env.model_env:ModelVectorEnv",
        "kwargs": {
            "system": "wiener_hammerstein",
            "mean": {"stiffness": 0.5, "damping": 0.15, "cubic": 1.0, "decay": 0.4},
            "process_noise": 1e-3,
            "measurement_noise": 1e-3,
            "horizon": 256,
            "max_input": 1.0,
            "max_output": 20.0,
        },
    },
    "duffing_env/Rig-v0": {
        "entry_point": "duffing_env.rig_env:RigEnv",
        "vector_entry_point": "duffing_env.rig_env:RigVectorEnv",
        "kwargs": {"horizon": 256},
    },
    "duffing_env/SilverboxReplay-v0": {
        "entry_point": "duffing_env.replay:SilverboxReplayEnv",
        "vector_entry_point": "duffing_env.vector_env:SilverboxReplayVectorEnv",
        "kwargs": {"regime": "multisine"},
    },
}


def register_tracks() -> None:
    """Register every track with Gymnasium; what is registered already is left as it is."""
    from gymnasium.envs.registration import register, registry

    # To Gymnasium a higher version is a newer one. Here v0 is the paper's equation, and v1 the differential equation.
    warnings.filterwarnings("ignore", r".*duffing_env/\w+-v0 is out of date", DeprecationWarning)

    for track_id, spec in TRACKS.items():
        if track_id not in registry:
            register(track_id, **spec)
