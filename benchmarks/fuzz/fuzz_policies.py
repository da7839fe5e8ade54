"""Fuzzing of policies: bad names, options and observations."""

from typing import Any

import gymnasium as gym
import numpy as np
from hypothesis import strategies as st

from agents import POLICIES, make_policy
from agents.policies import trained_policies
from benchmarks.fuzz.bad_values import anything, options
from benchmarks.fuzz.call_verdicts import Call

#: Options of policies, with their usual values.
_USUAL = {"horizon": None, "goal_std": None, "input_cost": 0.0, "seed": 0}


def calls() -> st.SearchStrategy[Call]:
    """Calls that make a policy or ask it for an action."""
    env = gym.make("duffing_env/Amplitude-v0")
    observation, _ = env.reset(seed=0)
    signals = [name for name in POLICIES if not name.startswith("efe")]
    names = [*signals, "efe-myopic", "efe-block-16", "ppo/amplitude"]
    made: dict[str, Any] = {name: make_policy(name, env) for name in names}
    made["a function"] = make_policy(lambda seen: 0.1 * seen[:, :1])

    @st.composite
    def call(draw: st.DrawFn) -> Call:
        change = draw(st.integers(0, 2))
        if change == 0:
            name: Any = draw(anything)
            return Call("make_policy of anything", lambda: make_policy(name, env), ("name", "policy"))
        if change == 1:
            name = draw(st.sampled_from([*POLICIES, *trained_policies()]))
            given = draw(options(dict(_USUAL)))
            given = {key: value for key, value in given.items() if value is not _USUAL.get(key, value) or key == "seed"}
            return Call(
                f"make_policy {name}", lambda: make_policy(name, env, **given), (*given, "options", "seed", "env")
            )
        name = draw(st.sampled_from(list(made)))
        value = draw(st.one_of(anything, st.just(observation), st.floats().map(lambda x: np.full(22, x))))
        state, begun = (draw(st.one_of(st.none(), st.none(), anything)) for _ in range(2))

        def function() -> str:
            action, _ = made[name].predict(value, state, begun, deterministic=True)
            bounded = np.isfinite(action).all() and (np.abs(action) <= 1).all() and action.shape[-1:] == (1,)
            return "" if bounded else f"action {action!r}"

        return Call(f"{name}: predict", function, ("observation", "state", "episode_start", "entries"), sound=str)

    return call()
