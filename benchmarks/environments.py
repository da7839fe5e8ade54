"""Section 2: environment steps per second, from one environment to thousands, beside other packages' environments.

An env-step is one environment's one step of its plant. The steps of ``NEXT_STEP`` autoreset that only start an episode
are not counted, here or with the peers. Every run covers whole episodes, with their resets and endings.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import SyncVectorEnv, VectorEnv

import duffing_env  # noqa: F401  registers the tracks
from benchmarks.component_timing import SAMPLES, EstimatorOnly, plant_only, play
from benchmarks.peer_process import Peers
from benchmarks.section_tables import Claim, Section, ratio
from benchmarks.timed_rounds import Row, later, measure, timed
from estimator.compilation.simd import LANES
from estimator.support.update_options import DEFAULT_ITERATIONS

#: Tracks of Eq. (2) and of Eq. (1).
TRACK, CONTINUOUS = "duffing_env/Amplitude-v0", "duffing_env/Amplitude-v1"

#: Unit of the rows.
UNIT = "env-steps/s"

#: Environments side by side.
SIZES = (1, 8, 64, 1024, 16384)

#: The same for Gymnasium's SyncVectorEnv.
SYNC_SIZES = (1, 8, 64, 1024)

#: Samples of an episode.
EPISODES = {TRACK: 256, CONTINUOUS: 256, "Pendulum-v1": 200, "CartPole-v1": 200}

#: Threads of torch for a policy.
POLICY_THREADS = 2

#: Samples of random actions; they repeat.
DRAWN_ACTIONS = 64

#: Number of environments of the ratios with a bar.
TARGET_SIZE = 1024

#: Options of known noises on a track of Eq. (1).
KNOWN: dict[str, Any] = {"noise_range": 1.0, "noise_hypotheses": 1}


def run(peers: Peers, repetitions: int, on_row: Callable[[str], None]) -> Section:
    """Time the environments."""
    rows = _single_rows() + [row for size in SIZES for row in _batch_rows(size, peers)]
    results = measure(rows, repetitions, on_row)
    n = TARGET_SIZE
    claims = []
    for rule in ("structured", "mean field", "continuous"):
        ours, is_target = results[f"{n}: ours, {rule}, 2 threads"], rule == "structured"
        claims += [
            Claim(f"ours, {rule}, 2 threads over EnvPool's Pendulum, 2 threads, at {n}",
                  ratio(ours, results[f"{n}: EnvPool Pendulum, 2 threads"]), bar=12 if is_target else None),
            Claim(f"ours, {rule}, 2 threads over Gymnasium's CartPoleVectorEnv, at {n}",
                  ratio(ours, results[f"{n}: Gymnasium CartPoleVectorEnv"]), bar=1 if is_target else None),
            Claim(f"ours, {rule}, 2 threads over gymnax's Pendulum called from Python, at {n}",
                  ratio(ours, results[f"{n}: gymnax Pendulum, calls"])),
            Claim(f"ours, {rule}, 2 threads over Gymnasium's SyncVectorEnv of Pendulum, at {n}",
                  ratio(ours, results[f"{n}: Gymnasium SyncVectorEnv Pendulum"])),
            Claim(f"ours, {rule}, through gym.make over Gymnasium's Pendulum",
                  ratio(results[f"single: ours, {rule}"], results["single: Gymnasium Pendulum"]),
                  bar=None if rule == "mean field" else 1),
        ]  # fmt: skip
    by_rule = {rule: results[f"{n}: ours, {rule}, 2 threads"] for rule in ("continuous", "structured")}
    claims.append(Claim(f"ours, continuous over structured, 2 threads, at {n}", ratio(*by_rule.values()), bar=0.5))
    unknown = results[f"{n}: ours, noises unknown, 2 threads"].median / 1e6
    claims.append(Claim(f"{UNIT}: ours, noises unknown, 2 threads, at {n}", unknown, bar=0.5, unit="M"))
    notes = [
        "structured: 3 iterations, mean field: 10, both of Eq. (2); continuous: 3 iterations of Eq. (1), the noises "
        "known as there; noises unknown: the same with 21 hypotheses about the noises, as on the tracks of Eq. (1). "
        "`ours` is the whole step through make_vec: plant, noise, inference, reward, observation, autoreset, infos. "
        "`plant only` and `estimator only` are the compiled pieces on one thread. SB3's policy is an untrained "
        "MlpPolicy (64, 64) that samples its actions, through agents' VecEnv.",
        f"Up to {LANES} environments are one block, which one thread steps. SyncVectorEnv is left out at 16384: its "
        "rate does not change from 8 environments on.",
    ]
    return Section("Environment steps", list(results.values()), claims, notes)


def _single_rows() -> list[Row]:
    return [
        Row("single: Gymnasium Pendulum", UNIT, timed(_single(gym.make("Pendulum-v1")))),
        *(
            Row(f"single: ours, {rule.replace('_', ' ')}", UNIT, timed(_single(gym.make(TRACK, factorisation=rule))))
            for rule in DEFAULT_ITERATIONS
        ),
        Row("single: ours, continuous", UNIT, timed(_single(gym.make(CONTINUOUS, **KNOWN)))),
        Row("single: ours, noises unknown", UNIT, timed(_single(gym.make(CONTINUOUS)))),
    ]


def _batch_rows(size: int, peers: Peers) -> list[Row]:
    data = play(size)
    rows = [Row(f"{size}: plant only", UNIT, timed(_piece(plant_only(size, data), size)))]
    for rule, iterations in DEFAULT_ITERATIONS.items():
        name = rule.replace("_", " ")
        alone = EstimatorOnly(data, rule, iterations)
        rows.append(Row(f"{size}: estimator only, {name}", UNIT, timed(_piece(alone.step, size))))
        rows += _ours(size, name, TRACK, factorisation=rule)
    rows += _ours(size, "continuous", CONTINUOUS, **KNOWN) + _ours(size, "noises unknown", CONTINUOUS)
    rows.append(Row(f"{size}: ours, structured, SB3 policy", UNIT, timed(later(partial(_policy_loop, size)))))
    if size in SYNC_SIZES:
        sync = SyncVectorEnv([lambda: gym.make("Pendulum-v1")] * size)
        one_by_one = timed(vector_steps(sync, EPISODES["Pendulum-v1"]))
        rows.append(Row(f"{size}: Gymnasium SyncVectorEnv Pendulum", UNIT, one_by_one))
    poles = gym.make_vec("CartPole-v1", num_envs=size, vectorization_mode="vector_entry_point")
    rows.append(Row(f"{size}: Gymnasium CartPoleVectorEnv", UNIT, timed(vector_steps(poles, EPISODES["CartPole-v1"]))))
    rows.append(peers.row(f"envpool {size}", f"{size}: EnvPool Pendulum, 2 threads", UNIT))
    rows.append(peers.row(f"gymnax {size}", f"{size}: gymnax Pendulum, calls", UNIT))
    rows.append(peers.row(f"gymnax-scan {size}", f"{size}: gymnax Pendulum, one call an episode", UNIT))
    return rows


def _ours(size: int, name: str, track: str, **options: Any) -> list[Row]:
    """Whole steps on one thread, and on two for more than one block."""
    rows = []
    for threads, title in ((1, "1 thread"), (2, "2 threads")):
        if threads == 1 or size > LANES:
            keywords: Any = {
                "num_envs": size,
                "vectorization_mode": "vector_entry_point",
                "threads": threads,
                **options,
            }
            envs = gym.make_vec(track, **keywords)
            rows.append(Row(f"{size}: ours, {name}, {title}", UNIT, timed(vector_steps(envs, EPISODES[track]))))
    return rows


def _single(env: gym.Env[Any, Any]) -> Callable[[int], float]:
    """Episodes of one environment, actions given."""
    low, high = env.action_space.low, env.action_space.high  # type: ignore[attr-defined]
    actions = np.random.default_rng(0).uniform(low, high, (DRAWN_ACTIONS, 1)).astype(np.float32)
    env.reset(seed=1)

    def action(count: int) -> float:
        steps = 0
        for _ in range(count):
            env.reset()
            ended = False
            while not ended:
                _, _, terminated, truncated, _ = env.step(actions[steps % DRAWN_ACTIONS])
                steps += 1
                ended = terminated or truncated
        return steps

    return action


def vector_steps(envs: VectorEnv[Any, Any, Any], episode: int) -> Callable[[int], float]:
    """Episodes of a vector environment with ``NEXT_STEP`` autoreset, actions given."""
    rng = np.random.default_rng(0)
    space = envs.single_action_space
    if isinstance(space, gym.spaces.Discrete):
        actions = rng.integers(0, int(space.n), (DRAWN_ACTIONS, envs.num_envs))
    else:
        assert isinstance(space, gym.spaces.Box)
        actions = rng.uniform(space.low, space.high, (DRAWN_ACTIONS, envs.num_envs, 1)).astype(np.float32)
    envs.reset(seed=1)

    def action(count: int) -> float:
        steps, resets = count * (episode + 1), 0
        for t in range(steps):
            _, _, terminated, truncated, _ = envs.step(actions[t % DRAWN_ACTIONS])
            resets += int(np.count_nonzero(terminated) + np.count_nonzero(truncated))
        return steps * envs.num_envs - resets

    return action


def _piece(step: Callable[[int], None], size: int) -> Callable[[int], float]:
    def action(count: int) -> float:
        for t in range(count * SAMPLES):
            step(t)
        return count * SAMPLES * size

    return action


def _policy_loop(size: int) -> Callable[[int], float]:
    """A policy of Stable-Baselines3 in the loop."""
    import torch
    from stable_baselines3 import PPO

    from agents.sb3_vec_env import DuffingVecEnv

    torch.set_num_threads(POLICY_THREADS)
    envs = DuffingVecEnv(TRACK, size, seed=1)
    model = PPO("MlpPolicy", envs, device="cpu", n_steps=2, batch_size=2 * size, seed=1)
    observations: Any = envs.reset()

    def action(count: int) -> float:
        nonlocal observations
        for _ in range(count * EPISODES[TRACK]):
            actions, _ = model.predict(observations)
            observations, _, _, _ = envs.step(actions)
        return count * EPISODES[TRACK] * size

    return action
