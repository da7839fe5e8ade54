"""Section 3: speed of the whole PPO loop, and the time from starting ``train.py`` to a useful policy.

A policy is useful if the 95 % interval of its log posterior gain over 256 systems lies above every fixed excitation's.
"""

import math
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from functools import cache, partial
from pathlib import Path
from typing import Any

from agents.evaluation.metric_summary import summarise_metrics
from agents.evaluation.policy_evaluation import evaluate_policies
from agents.policies.networks.trained_policy import CARD_FILE
from agents.training import PPOSettings, TrainConfig
from benchmarks.peer_process import ROOT
from benchmarks.section_tables import Claim, Section, ratio
from benchmarks.timed_rounds import CORES, Row, measure

#: Track of the trainings.
TRACK = TrainConfig.env

#: Fixed excitations that a useful policy exceeds.
EXCITATIONS = ("silverbox-multisine", "silverbox-arrow", "uniform", "prbs")

#: Systems of an evaluation.
SYSTEMS = 256

#: Metric of an evaluation.
METRIC = "log_posterior_gain"

#: Checkpoints of a training.
CHECKPOINTS = 50

#: Length of a training [samples].
ENOUGH = 1_500_000

#: Longest training [s].
PATIENCE = 120.0

#: Longest median time to a useful policy that passes [s].
TARGET_SECONDS = 60.0

#: Names of the rows, for Stable-Baselines3 by number of environments.
OURS = "ours, PPO's settings without features"
DEFAULTS = {1: "SB3's defaults, DummyVecEnv of 1", 8: "SB3's defaults, DummyVecEnv of 8"}
USEFUL = "from starting train.py to a useful policy"


def run(repetitions: int, on_row: Callable[[str], None]) -> Section:
    """Time the loops, then the trainings."""
    rows = [Row(OURS, "env-steps/s", _loop(_our_model, TrainConfig.torch_threads))]
    rows += [Row(name, "env-steps/s", _loop(partial(_default_model, n), CORES)) for n, name in DEFAULTS.items()]
    results = measure(rows, repetitions, on_row)
    reached: list[dict[str, float]] = []
    bars = _bars()
    seeds = iter(range(repetitions))
    training = measure(
        [Row(USEFUL, "s", lambda _: (_time_to_useful(next(seeds), max(bars.values()), reached), 1), at_least=0)],
        repetitions,
        on_row,
    )
    fastest = max((results[name] for name in DEFAULTS.values()), key=lambda r: -1 if math.isnan(r.median) else r.median)
    claims = [
        Claim(f"PPO's whole loop: ours over {fastest.name}", ratio(results[OURS], fastest), bar=15),
        Claim(f"{USEFUL}, compilation included", training[USEFUL].median, bar=TARGET_SECONDS, at_most=True, unit="s"),
    ]
    found = ", ".join(f"{r['samples'] / 1e6:.1f} M samples: [{r['low']:.2f}, {r['high']:.2f}]" for r in reached)
    notes = [
        "Loop: roll-outs, updates and everything between, of PPO.learn after its first round. Ours: "
        f"{PPOSettings().num_envs} environments x {PPOSettings().n_steps} samples an update, batches of "
        f"{PPOSettings().batch_size}, {PPOSettings().n_epochs} epochs, {TrainConfig.torch_threads} thread of torch. "
        f"SB3's: 2048 samples of each environment, batches of 64, 10 epochs, {CORES} threads.",
        f"Useful: a checkpoint (every {TrainConfig.steps // CHECKPOINTS:,} samples) whose {METRIC.replace('_', ' ')} "
        f"over {SYSTEMS} systems has its 95 % interval above the intervals of all fixed excitations, with upper ends "
        + ", ".join(f"{name} {high:.2f}" for name, high in bars.items())
        + f" nat. Each run has another seed and an empty cache of compiled code. Reached at {found}.",
    ]
    return Section(
        "Training", [*results.values(), *training.values()], claims, notes, {"bars": bars, "reached": reached}
    )


def _loop(make: Callable[[], Any], threads: int) -> Callable[[int], tuple[float, float]]:
    """Time rounds of roll-out and update of a model, which is made at the first call, on a number of torch threads."""
    made = cache(make)

    def run(count: int) -> tuple[float, float]:
        import torch

        torch.set_num_threads(threads)
        model = made()
        before = model.num_timesteps
        started = time.perf_counter()
        model.learn(count * model.n_steps * model.n_envs, reset_num_timesteps=False)
        return time.perf_counter() - started, model.num_timesteps - before

    return run


def _our_model() -> Any:
    from agents.sb3_vec_env import DuffingVecEnv

    return PPOSettings().make(DuffingVecEnv(TRACK, PPOSettings().num_envs, seed=0), seed=0)


def _default_model(num_envs: int) -> Any:
    from stable_baselines3 import PPO
    from stable_baselines3.common.env_util import make_vec_env

    return PPO("MlpPolicy", make_vec_env(TRACK, n_envs=num_envs, seed=0), seed=0)


def _bars() -> dict[str, float]:
    """Upper end of each fixed excitation's interval."""
    return {
        e.policy: float(summarise_metrics(e)[METRIC]["high"]) for e in evaluate_policies(EXCITATIONS, TRACK, SYSTEMS)
    }


def _time_to_useful(seed: int, bar: float, reached: list[dict[str, float]]) -> float:
    """Run ``train.py``, evaluate its checkpoints in order, and return the time until the first useful one [s]."""
    with tempfile.TemporaryDirectory() as folder:
        output = Path(folder) / "run"
        started = time.time()
        for checkpoint in _train_a_while(output, seed, Path(folder) / "cache"):
            interval = summarise_metrics(evaluate_policies([str(checkpoint)], TRACK, SYSTEMS)[0])[METRIC]
            if float(interval["low"]) > bar:
                low, high = float(interval["low"]), float(interval["high"])
                reached.append({"samples": float(checkpoint.name), "low": low, "high": high})
                return (checkpoint / CARD_FILE).stat().st_mtime - started
    raise RuntimeError(f"seed {seed} is not useful after {ENOUGH:,} samples or {PATIENCE:.0f} s")


def _train_a_while(output: Path, seed: int, cache: Path) -> list[Path]:
    """Run ``train.py`` up to a checkpoint that must be useful; return its checkpoints in order.

    It is the beginning of a whole run, with the whole run's schedule.
    """
    words = f"--output {output} --seed {seed} --checkpoints {CHECKPOINTS}".split()
    command = [sys.executable, "train.py", *words]
    with open(output.with_suffix(".log"), "w+") as log:
        process = subprocess.Popen(
            command, cwd=ROOT, env={**os.environ, "NUMBA_CACHE_DIR": str(cache)}, stdout=log, stderr=log
        )
        deadline = time.monotonic() + PATIENCE
        found: list[Path] = []
        while process.poll() is None and time.monotonic() < deadline and (not found or int(found[-1].name) < ENOUGH):
            time.sleep(0.2)
            found = sorted(card.parent for card in output.glob(f"checkpoints/*/{CARD_FILE}"))
        if process.poll() is None:
            process.terminate()
        elif process.returncode:
            log.seek(0)
            raise RuntimeError((log.read().strip().splitlines() or ["train.py failed and says nothing"])[-1])
        process.wait()
    return found
