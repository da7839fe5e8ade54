"""The peers' rows. Runs in the peers' own environment, as a child of the benchmark, and imports nothing of ours.

``python -I peers.py SAMPLES.npz`` reads a request per line, ``["row", count]``, runs that row, ``count`` times as
long, and answers with a line: ``{"seconds": ..., "work": ...}`` or ``{"error": ...}``. Each row is set up when it is
first asked for, so that a peer that is missing costs its own rows only. The request ``["versions", 0]`` answers with
versions. So the benchmark can alternate between its own rows and these.

What is counted as work: env-steps, without the steps of ``NEXT_STEP`` autoreset, which only start an episode; or
samples. Every row covers whole episodes, its resets included.
"""

# The peers are not installed where types are checked.
# mypy: disable-error-code="import-not-found"

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Callable
from functools import cache, partial
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np

Run = Callable[[int], dict[str, Any]]

PACKAGES = (
    *("envpool", "gymnax", "jax", "jaxlib", "gymnasium", "filterpy", "dynamax", "padasip", "fastcan", "scikit-learn"),
    *("pysindy", "numpy", "scipy"),
)
EPISODE = 200
POOL_THREADS = 2
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
    """What the estimators get, as `benchmarks.estimators` or `benchmarks.silverbox` wrote it."""
    with np.load(sys.argv[1]) as file:
        return {name: file[name] for name in file.files}


def estimator(identify: Callable[[], Any]) -> Run:
    """Time a function that goes through all samples once and returns the coefficients (θ1, θ2, θ3, η)."""

    def run(count: int) -> dict[str, Any]:
        started = time.perf_counter()
        for _ in range(count):
            coefficients = np.asarray(identify(), dtype=np.float64)
        seconds = time.perf_counter() - started
        return {"seconds": seconds, "work": count * len(samples()["y"]), "coefficients": coefficients.tolist()}

    return run


def filterpy_ukf() -> Run:
    """The unscented Kalman filter of filterpy, on (x_t, x_{t-1}, θ1, θ2, θ3, η)."""
    from filterpy.kalman import MerweScaledSigmaPoints, UnscentedKalmanFilter

    given = samples()

    def transition(state: Any, dt: float, u: float) -> Any:
        x, last, theta1, theta2, theta3, eta = state
        return np.array([theta1 * x + theta2 * x**3 + theta3 * last + eta * u, x, theta1, theta2, theta3, eta])

    def identify() -> Any:
        points = MerweScaledSigmaPoints(6, alpha=0.1, beta=2.0, kappa=-3.0)
        ukf = UnscentedKalmanFilter(6, 1, 1.0, hx=lambda state: state[:1], fx=transition, points=points)
        ukf.x, ukf.P = given["mean"].copy(), given["cov"].copy()
        ukf.Q, ukf.R = given["process_cov"], given["measurement_cov"]
        for u, y in zip(given["acting"].tolist(), given["y"].tolist(), strict=True):
            ukf.predict(u=u)
            ukf.update(y)
        return ukf.x[2:]

    return estimator(identify)


def dynamax_ekf() -> Run:
    """The extended Kalman filter of dynamax, on the same state: one compiled scan over all samples, in float64.

    It conditions first, then predicts with the *next* input, so that the inputs are those that act on each output.
    """
    import jax
    import jax.numpy as jnp
    from dynamax.nonlinear_gaussian_ssm import ParamsNLGSSM, extended_kalman_filter

    given = samples()

    def transition(state: Any, u: Any) -> Any:
        x, last, theta1, theta2, theta3, eta = state
        return jnp.stack(
            [theta1 * x + theta2 * x**3 + theta3 * last + eta * u[0], x, theta1, theta2, theta3, eta]
        )  # fmt: skip

    with jax.enable_x64(True):
        model = {name: jnp.asarray(given[name]) for name in ("mean", "cov", "process_cov", "measurement_cov")}
        y, acting = jnp.asarray(given["y"])[:, None], jnp.asarray(given["acting"])[:, None]

        @jax.jit
        def last_mean(y: Any, acting: Any) -> Any:
            params = ParamsNLGSSM(
                initial_mean=model["mean"],
                initial_covariance=model["cov"],
                dynamics_function=transition,
                dynamics_covariance=model["process_cov"],
                emission_function=lambda state, u: state[:1],
                emission_covariance=model["measurement_cov"],
            )
            return extended_kalman_filter(params, y, acting, output_fields=["filtered_means"]).filtered_means[-1]

    def identify() -> Any:
        with jax.enable_x64(True):
            return last_mean(y, acting).block_until_ready()[2:]

    return estimator(identify)


def padasip_rls() -> Run:
    """The recursive least squares of padasip, on (y_t, y_t³, y_{t-1}, u_t): no latent state, no noise model."""
    from padasip.filters import FilterRLS

    given = samples()
    y = given["y"]
    regressors = np.column_stack([y[1:-1], y[1:-1] ** 3, y[:-2], given["acting"][2:]])

    def identify() -> Any:
        rls = FilterRLS(4, mu=1.0, eps=1e-6, w="zeros")
        rls.run(y[2:], regressors)
        return rls.w

    return estimator(identify)


@cache
def row(name: str) -> Run:
    """The row of this name, set up.

    ``filterpy``, ``dynamax``, ``padasip``; a name and a number of environments; ``silverbox`` and what
    `benchmarks.silverbox_peers.row` takes; or ``rigs`` and what `benchmarks.rigs.peer_rows.row` takes.
    """
    estimators = {"filterpy": filterpy_ukf, "dynamax": dynamax_ekf, "padasip": padasip_rls}
    if name in estimators:
        return estimators[name]()
    environments: dict[str, Callable[[int], Run]] = {
        "envpool": envpool_pendulum,
        "gymnax": partial(gymnax_pendulum, scanned=False),
        "gymnax-scan": partial(gymnax_pendulum, scanned=True),
    }
    kind, _, rest = name.partition(" ")
    if kind == "silverbox":
        sys.path.append(str(Path(__file__).parent))
        from silverbox_peers import row as silverbox_row

        return silverbox_row(samples(), *rest.split())
    if kind == "rigs":
        sys.path.append(str(Path(__file__).parent / "rigs"))
        from peer_rows import row as rigs_row

        return rigs_row(samples(), *rest.split())
    return environments[kind](int(rest))


def versions() -> dict[str, str]:
    """Versions of what is installed here."""
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
