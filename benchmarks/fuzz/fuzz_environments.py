"""Fuzzing of single and vector environments: `step` and `reset` with bad values."""

import pickle
from typing import Any

import gymnasium as gym
import numpy as np
from hypothesis import strategies as st

import duffing_env  # noqa: F401  registers the tracks
from benchmarks.fuzz.bad_values import anything
from benchmarks.fuzz.call_verdicts import Call

#: Environments by name: track, options, and number of environments; 0 for a single one.
MADE: dict[str, tuple[str, dict[str, Any], int]] = {
    "Amplitude-v0": ("duffing_env/Amplitude-v0", {"horizon": 20}, 0),
    "Power-v0, held": ("duffing_env/Power-v0", {"horizon": 20, "hold": 3}, 0),
    "mean field": ("duffing_env/Amplitude-v0", {"horizon": 20, "factorisation": "mean_field"}, 0),
    "40 of Amplitude-v0": ("duffing_env/Amplitude-v0", {"horizon": 9}, 40),
    "3 by hand": ("duffing_env/Amplitude-v0", {"horizon": 9, "autoreset_mode": "Disabled"}, 3),
}


def make(name: str) -> Any:
    """Make an environment, in the middle of an episode."""
    track, options, rows = MADE[name]
    if rows:
        env: Any = gym.make_vec(track, num_envs=rows, vectorization_mode="vector_entry_point", **options)
    else:
        env = gym.make(track, disable_env_checker=True, **options).unwrapped
    env.reset(seed=0)
    env.step(np.full((rows, 1) if rows else (1,), 0.5, dtype=np.float32))
    return env


def unsound(env: Any, result: Any) -> str:
    """What is wrong with a result of `reset` or `step`; empty where nothing is."""
    observation = result[0]
    if not env.observation_space.contains(observation):
        return "the observation is out of bounds"
    if len(result) == 5 and not np.isfinite(result[1]).all():
        return "the reward is not finite"
    return ""


def calls() -> st.SearchStrategy[Call]:
    """Calls of an environment's methods."""
    pool = {name: pickle.dumps(make(name)) for name in MADE}

    @st.composite
    def call(draw: st.DrawFn) -> Call:
        name = draw(st.sampled_from(list(MADE)))
        env, rows = pickle.loads(pool[name]), MADE[name][2]
        if draw(st.booleans()):
            shape = (rows, 1) if rows else (1,)
            value = draw(anything)
            if draw(st.booleans()):
                actions = np.full(shape, draw(st.floats(-1e6, 1e6)))
                if draw(st.booleans()):
                    actions[-1] = draw(st.sampled_from([np.nan, np.inf, 1e308, -1e308, 1e-300]))
                value = actions
            function = lambda: env.step(value)  # noqa: E731
            names: tuple[str, ...] = ("action", "actions", "row")
        else:
            seed = draw(st.one_of(anything, st.lists(st.integers(-2, 9), min_size=rows or 1, max_size=rows or 1)))
            options = draw(st.one_of(st.none(), st.none(), anything.map(lambda value: {"reset_mask": value})))
            function = lambda: env.reset(seed=seed, options=options)  # noqa: E731
            names = ("seed", "Seed", "reset_mask", "options")
        what = f"{name}: {'step' if names[0] == 'action' else 'reset'}"
        return Call(what, function, names, lambda: env, lambda result: unsound(env, result))

    return call()
