"""Timed rows of one version of this project; `benchmarks.version_comparison` runs them as a child in its tree.

The process answers requests like `benchmarks.peers`. Versions without `estimator.engine` name the update otherwise.
"""

import json
import os
import sys
import time
from collections.abc import Callable
from importlib.util import find_spec
from typing import Any

import gymnasium as gym
import numba
import numpy as np

import duffing_env  # noqa: F401  registers the tracks

#: Environments side by side.
SIZE = 1024

#: Samples of a record.
SAMPLES = 256

#: Samples of random actions; they repeat.
DRAWN_ACTIONS = 64

#: Track of Eq. (1): under its older name where a version has it.
_EQUATION_1 = "duffing_env/Continuous-v0"
if _EQUATION_1 not in gym.registry:
    _EQUATION_1 = "duffing_env/Amplitude-v1"

#: Options that make its noises known; the older track has known noises.
KNOWN: dict[str, Any] = {"noise_range": 1.0, "noise_hypotheses": 1} if _EQUATION_1.endswith("1") else {}

#: Track of each row.
TRACKS = {
    "Eq. (2)": "duffing_env/Amplitude-v0",
    "Eq. (1)": _EQUATION_1,
    "Eq. (1), noises unknown": "duffing_env/Amplitude-v1",
}

#: Whether this version has the engine.
HAS_ENGINE = find_spec("estimator.engine") is not None

Action = Callable[[int], float]


def recorded() -> tuple[Any, Any]:
    """Inputs and outputs (SAMPLES, SIZE) of an oscillator near the Silverbox's, under uniform inputs."""
    rng = np.random.default_rng(0)
    u = rng.uniform(-0.15, 0.15, (SAMPLES, SIZE))
    x = np.zeros((SAMPLES + 2, SIZE))
    for t in range(SAMPLES):
        now, last = x[t + 1], x[t]
        x[t + 2] = 1.478 * now - 1.506 * now**3 - 0.961 * last + 0.4 * u[t] + 5e-4 * rng.standard_normal(SIZE)
    return u, x[2:] + 5e-4 * rng.standard_normal((SAMPLES, SIZE))


def update_of(equation: str) -> tuple[Any, list[int], int, int]:
    """The compiled update of a block, the rows of its inputs (the last and its rise, for Eq. (1)), output, and all."""
    continuous = equation == "Eq. (1)"
    if HAS_ENGINE:
        from estimator import difference, duffing

        try:
            from estimator.engine.kernels import compile_belief_update
        except ImportError:  # the names of an older version
            from estimator.engine.tasks import structured as compile_belief_update

        task = compile_belief_update(duffing() if continuous else difference(), int(continuous))
        prefix = "U_u" if "U_u_0" in task.layout else "U"  # the latter in an older version
        inputs = [task.layout[f"{prefix}_{k}"] for k in range(1 + continuous)]
        return task.update, inputs, task.layout["Y_y"], len(task.layout)

    from estimator.record import LAYOUT, N_ROWS

    from estimator.inference import continuous as ode
    from estimator.inference import update

    substeps = ode.SUBSTEPS

    @numba.njit
    def integrate(W: Any) -> None:
        ode.update(W, 3, substeps)

    @numba.njit
    def regress(W: Any) -> None:
        update(W, True, 3, False, W[:0])

    inputs = [LAYOUT["last_u"], LAYOUT["u"]] if continuous else [LAYOUT["u"]]
    return integrate if continuous else regress, inputs, LAYOUT["y"], N_ROWS


def inference(equation: str) -> Action:
    """Structured inference alone, of SIZE systems; every SAMPLES samples it begins again at the track's prior."""
    from estimator.compilation.simd import LANES

    env = gym.make(TRACKS[equation], **(KNOWN if equation == "Eq. (1)" else {})).unwrapped
    env.reset(seed=0)
    prior = env.records[0]  # type: ignore[attr-defined]
    update, rows, y_row, n_rows = update_of(equation)
    u, y = recorded()
    before = np.concatenate([np.zeros((1, SIZE)), u[:-1]])
    series = np.stack([*((before, u - before if HAS_ENGINE else u) if len(rows) > 1 else (u,)), y])
    places = np.array([*rows, y_row]) * LANES
    blocks = np.zeros((SIZE // LANES, n_rows * LANES))

    @numba.njit(nogil=True)
    def infer_all(blocks: Any, series: Any, places: Any) -> None:
        for b in range(len(blocks)):
            W = blocks[b]
            for k in range(len(places)):
                for j in range(LANES):
                    W[places[k] + j] = series[k, b * LANES + j]
            update(W)

    def action(count: int) -> float:
        for t in range(count * SAMPLES):
            if t % SAMPLES == 0:
                blocks[:, : len(prior) * LANES] = np.repeat(prior, LANES)
            infer_all(blocks, np.ascontiguousarray(series[:, t % SAMPLES]), places)
        assert np.isfinite(blocks[:, : len(prior) * LANES]).all()
        return count * SAMPLES * SIZE

    return action


def steps(equation: str) -> Action:
    """The whole step through make_vec, with resets and endings; steps that only start an episode do not count."""
    options: Any = {"num_envs": SIZE, "vectorization_mode": "vector_entry_point", "threads": 2}
    options |= KNOWN if equation == "Eq. (1)" else {}
    envs = gym.make_vec(TRACKS[equation], **options)
    actions = np.random.default_rng(0).uniform(-1, 1, (DRAWN_ACTIONS, SIZE, 1)).astype(np.float32)
    envs.reset(seed=1)

    def action(count: int) -> float:
        resets = 0
        for t in range(count * (SAMPLES + 1)):
            _, _, terminated, truncated, _ = envs.step(actions[t % DRAWN_ACTIONS])
            resets += int(np.count_nonzero(terminated) + np.count_nonzero(truncated))
        return count * (SAMPLES + 1) * SIZE - resets

    return action


def samples(equation: str) -> Action:
    """One estimator that is given samples one by one."""
    u, y = (series[:, 0].tolist() for series in recorded())
    if HAS_ENGINE:
        from estimator import OnlineEstimator, difference, duffing

        estimator = OnlineEstimator(difference() if equation == "Eq. (2)" else duffing())
    else:
        from estimator import NLARX, DuffingODE, OnlineEstimator

        estimator = OnlineEstimator(NLARX() if equation == "Eq. (2)" else DuffingODE())

    def action(count: int) -> float:
        for t in range(count * SAMPLES):
            estimator.update(u[t % SAMPLES], y[t % SAMPLES])
        return count * SAMPLES

    return action


def main() -> None:
    """Answer requests until the input ends."""
    answers = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)  # What packages print must not get between the answers.
    actions: dict[str, Action] = {}
    for line in sys.stdin:
        name, count = json.loads(line)
        try:
            if name not in actions:
                kind, _, equation = name.partition(" ")
                actions[name] = {"inference": inference, "steps": steps, "samples": samples}[kind](equation)
            started = time.perf_counter()
            work = actions[name](count)
            answer = {"seconds": time.perf_counter() - started, "work": work}
        except Exception as error:
            answer = {"error": f"{type(error).__name__}: {error}"}
        print(json.dumps(answer), file=answers)


if __name__ == "__main__":
    main()
