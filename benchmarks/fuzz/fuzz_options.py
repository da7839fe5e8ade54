"""Fuzzing of every track's options, one to three of them bad; an environment that can be made plays five samples."""

from dataclasses import fields
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.envs.registration import load_env_creator
from hypothesis import strategies as st

from benchmarks.fuzz.bad_values import options
from benchmarks.fuzz.call_verdicts import Call
from benchmarks.fuzz.fuzz_environments import unsound
from benchmarks.fuzz.fuzz_estimators import RIG
from duffing_env.plants.silverbox_record import record_available
from duffing_env.tracks.track_registry import TRACKS

#: Options whose every value compiles a kernel; most of their values are wrapped in a list, which is refused.
_COSTLY = {"iterations", "factorisation", "reward", "estimator", "system", "interpolation", "nonlinear"}


def calls() -> st.SearchStrategy[Call]:
    """Calls that make an environment and play five samples."""
    tracks = [track for track in TRACKS if record_available() or "Replay" not in track]
    known, made = {}, {}
    for track in tracks:
        given = {"rig": RIG} if "Rig" in track else {}
        env: Any = gym.make(track, disable_env_checker=True, **given).unwrapped
        made[track] = load_env_creator(gym.spec(track).entry_point)  # type: ignore[arg-type]
        known[track] = ({one.name: getattr(env.experiment, one.name) for one in fields(env.experiment)}, given)

    @st.composite
    def call(draw: st.DrawFn) -> Call:
        track = draw(st.sampled_from(tracks))
        usual, given = known[track]
        asked: dict[str, Any] = draw(options({**usual, "render_mode": None}))
        asked = {name: value for name, value in asked.items() if name not in usual or value is not usual[name]}
        for name in _COSTLY & set(asked):
            if isinstance(asked[name], int | str | np.integer) and draw(st.integers(0, 9)):
                asked[name] = [asked[name]]

        def function() -> str:
            env: Any = made[track](**{**gym.spec(track).kwargs, **given, **asked})
            fault = unsound(env, env.reset(seed=1))
            for action in (1.0, -1.0, 0.0, 1.0, 1.0):
                result = env.step([action])
                fault = fault or unsound(env, result)
                if result[2] or result[3]:
                    env.reset()
            return fault

        return Call(track, function, (*usual, *asked), sound=str, given=asked)

    return call()
