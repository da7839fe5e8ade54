"""Rows of peer packages, run as a child of the benchmark in the peers' environment, without our packages.

``python -I peers.py SAMPLES.npz`` reads a request per line, ``["row", count]``, runs that row, ``count`` times as
long, and answers with a line: ``{"seconds": ..., "work": ...}`` or ``{"error": ...}``. Each row is set up at its first
request, so that a missing peer costs its own rows only. The request ``["versions", 0]`` returns versions. So the
benchmark can alternate between its own rows and these.

Work counts env-steps, without the steps of ``NEXT_STEP`` autoreset, which only start an episode; or samples. Every row
covers whole episodes with their resets.
"""

import json
import os
import sys
import time
from collections.abc import Callable
from functools import cache, partial
from importlib import import_module
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np

Run = Callable[[int], dict[str, Any]]

#: Packages whose versions are printed.
PACKAGES = (
    *("envpool", "gymnax", "jax", "jaxlib", "gymnasium", "filterpy", "dynamax", "padasip", "fastcan", "scikit-learn"),
    *("pysindy", "numpy", "scipy"),
)

#: Samples of an episode.
EPISODE = 200

#: Threads of EnvPool.
POOL_THREADS = 2

#: Samples of random actions; they repeat.
DRAWN_ACTIONS = 64


def envpool_pendulum(num_envs: int) -> Run:
    """EnvPool's Pendulum, synchronous, with two threads, stepped from Python."""
    import envpool

    envs = envpool.make("Pendulum-v1", env_type="gymnasium", num_envs=num_envs, num_threads=POOL_THREADS, seed=1)
    actions = np.random.default_rng(0).uniform(-2, 2, (DRAWN_ACTIONS, num_envs, 1)).astype(np.float32)
    envs.reset()

    def run(count: int) -> dict[str, Any]:
        steps = count * (EPISODE + 1)
        finished = 0
        started = time.perf_counter()
        for t in range(steps):
            _, _, terminated, truncated, _ = envs.step(actions[t % DRAWN_ACTIONS])
            finished += int(np.count_nonzero(terminated) + np.count_nonzero(truncated))
        return {"seconds": time.perf_counter() - started, "work": steps * num_envs - finished}

    return run


def gymnax_pendulum(num_envs: int, scanned: bool) -> Run:
    """The Pendulum of gymnax: compiled steps called from Python, or a whole episode in one compiled call.

    Called from Python, the actions are given and the calls may run ahead: the results are awaited once, at the end.
    In one call, the actions are drawn within, and all outputs are summed, so that none is optimised away.
    """
    import gymnax
    import jax
    import jax.numpy as jnp

    env, params = gymnax.make("Pendulum-v1")
    reset = jax.jit(jax.vmap(env.reset, in_axes=(0, None)))
    step_all = jax.vmap(env.step, in_axes=(0, 0, 0, None))

    @jax.jit
    def step(key: Any, state: Any, action: Any) -> Any:
        key, drawn = jax.random.split(key)
        observation, state, reward, terminated, truncated, _ = step_all(
            jax.random.split(drawn, num_envs), state, action, params
        )
        return key, state, observation, reward, terminated, truncated

    @jax.jit
    def episode(key: Any, state: Any) -> Any:
        def body(carry: Any, _: None) -> Any:
            key, state, total = carry
            key, drawn = jax.random.split(key)
            action = jax.random.uniform(drawn, (num_envs, 1), minval=-2.0, maxval=2.0)
            key, state, *outputs = step(key, state, action)
            return (key, state, total + sum(jnp.sum(output) for output in outputs)), None

        carry, _ = jax.lax.scan(body, (key, state, jnp.zeros(())), None, length=EPISODE)
        return carry

    key = jax.random.key(0)
    _, state = reset(jax.random.split(key, num_envs), params)
    drawn = np.random.default_rng(0).uniform(-2, 2, (DRAWN_ACTIONS, num_envs, 1))
    actions = [jnp.asarray(action, dtype=jnp.float32) for action in drawn]

    def run(count: int) -> dict[str, Any]:
        nonlocal key, state
        outputs: Any = None
        started = time.perf_counter()
        if scanned:
            for _ in range(count):
                key, state, outputs = episode(key, state)
        else:
            for t in range(count * EPISODE):
                key, state, *outputs = step(key, state, actions[t % DRAWN_ACTIONS])
        jax.block_until_ready((state, outputs))
        return {"seconds": time.perf_counter() - started, "work": count * EPISODE * num_envs}

    return run


@cache
def samples() -> dict[str, Any]:
    """Read the estimators' input, which `benchmarks.estimators` has written."""
    with np.load(sys.argv[1]) as file:
        return {name: file[name] for name in file.files}


@cache
def row(name: str) -> Run:
    """Set up the row of a name.

    A kind of environment and a number of them; ``silverbox`` and what `benchmarks.silverbox_peer_filters.row` takes; or
    ``rigs`` and what `benchmarks.rigs.peer_methods.row` takes.
    """
    kind, _, rest = name.partition(" ")
    modules = {"silverbox": ("silverbox_peer_filters", ""), "rigs": ("peer_methods", "rigs")}
    if kind in modules:
        module, folder = modules[kind]
        sys.path.append(str(Path(__file__).parent / folder))
        made: Run = import_module(module).row(samples(), *rest.split())
        return made
    environments: dict[str, Callable[[int], Run]] = {
        "envpool": envpool_pendulum,
        "gymnax": partial(gymnax_pendulum, scanned=False),
        "gymnax-scan": partial(gymnax_pendulum, scanned=True),
    }
    return environments[kind](int(rest))


def versions() -> dict[str, str]:
    """Versions of the packages that are installed here."""
    found = {}
    for package in PACKAGES:
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            found[package] = "not installed"
    return found


def main() -> None:
    """Answer requests until the input ends."""
    answers = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)  # What packages print must not get between the answers.
    for line in sys.stdin:
        name, count = json.loads(line)
        try:
            answer = versions() if name == "versions" else row(name)(count)
        except Exception as error:
            answer = {"error": f"{type(error).__name__}: {error}"}
        print(json.dumps(answer), file=answers)


if __name__ == "__main__":
    main()
