"""Section 4: time of a policy network's decision, with features and shield, on one thread."""

import time
from collections.abc import Callable

import gymnasium as gym

from agents import make_policy
from benchmarks.section_tables import Claim, Section
from benchmarks.timed_rounds import Row, measure

#: Longest time of a decision for one environment and for many, by track and policy [µs].
BARS = {("Amplitude-v0", "ppo/amplitude"): (15.0, 3.0), ("Amplitude-v1", "ppo/amplitude-v1"): (30.0, 6.0)}

#: Number of many environments.
MANY = 1024

#: Samples before timing, so that observations are from the middle of an episode.
_SETTLED = 40


def run(repetitions: int, on_row: Callable[[str], None]) -> Section:
    """Time ``predict`` for one environment and for many."""
    bars = {}
    rows = []
    for (track, name), (one, many) in BARS.items():
        for count, bar in ((1, one), (MANY, many)):
            row = Row(f"{name} on {track}, {count:,} at once", "µs/decision", _decisions(track, name, count))
            rows.append(row)
            bars[row.name] = bar
    results = measure(rows, repetitions, on_row)
    claims = [Claim(name, results[name].median, bar, at_most=True, unit="µs") for name, bar in bars.items()]
    return Section("Decisions", list(results.values()), claims, [])


def _decisions(track: str, name: str, count: int) -> Callable[[int], tuple[float, float]]:
    """Time decisions for a number of environments at one observation."""
    envs = gym.make_vec(f"duffing_env/{track}", num_envs=count, vectorization_mode="vector_entry_point")
    policy = make_policy(name, envs)
    observations, _ = envs.reset(seed=0)
    for _ in range(_SETTLED):
        observations, *_ = envs.step(policy.predict(observations, deterministic=True)[0])
    seen = observations[0] if count == 1 else observations

    def decide(rounds: int) -> tuple[float, float]:
        started = time.perf_counter()
        for _ in range(rounds):
            policy.predict(seen, deterministic=True)
        return time.perf_counter() - started, rounds * count

    return decide
