"""Section 5: what one waits for before the first step, and how much memory many environments take."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from collections.abc import Callable

from benchmarks.peer_process import ROOT
from benchmarks.report import Claim, Section
from benchmarks.timing import Row, measure

PACKAGES = ("estimator", "duffing_env", "agents", "gymnasium", "numba", "stable_baselines3")
MANY = 16384
FIRST_COLD, FIRST_WARM = "first compiled call, nothing cached", "first compiled call, cached"
MEMORY, MEMORY_BARE = f"peak memory, {MANY:,} environments", "peak memory, 1 environment"

_IMPORT = """
import sys, time
started = time.perf_counter()
import {package}
print(time.perf_counter() - started)
print("torch" in sys.modules or "matplotlib" in sys.modules)
"""

# The first call is everything between the import and the first observation: make_vec, reset and one step.
_FIRST_CALL = """
import time
import gymnasium, numpy, duffing_env
started = time.perf_counter()
envs = gymnasium.make_vec("duffing_env/Amplitude-v0", num_envs={size}, vectorization_mode="vector_entry_point")
envs.reset(seed=0)
envs.step(numpy.zeros(({size}, 1), dtype=numpy.float32))
print(time.perf_counter() - started)
for _ in range({steps}):
    envs.step(numpy.zeros(({size}, 1), dtype=numpy.float32))
try:
    # Not ru_maxrss, which begins at the size of the process that started this one.
    lines = open("/proc/self/status").read().splitlines()
    print(next(int(line.split()[1]) / 2**10 for line in lines if line.startswith("VmHWM")))
except OSError:
    import resource, sys
    print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (2**20 if sys.platform == "darwin" else 2**10))
"""


def run(repetitions: int, on_row: Callable[[str], None]) -> Section:
    """Time imports and first calls, each in a fresh process."""
    with tempfile.TemporaryDirectory() as cache:
        _script(_FIRST_CALL.format(size=1, steps=0), cache)  # fills the cache
        rows = [Row(f"import {package}", "s", _importing(package, cache), at_least=0) for package in PACKAGES]
        rows += [
            Row(FIRST_WARM, "s", lambda _: (float(_script(_FIRST_CALL.format(size=1, steps=0), cache)[0]), 1), 0),
            Row(FIRST_COLD, "s", _cold, at_least=0),
            Row(MEMORY_BARE, "MiB", lambda _: (float(_script(_FIRST_CALL.format(size=1, steps=300), cache)[1]), 1), 0),
            Row(MEMORY, "MiB", lambda _: (float(_script(_FIRST_CALL.format(size=MANY, steps=300), cache)[1]), 1), 0),
        ]
        results = measure(rows, repetitions, on_row)
        _, is_heavy = _script(_IMPORT.format(package="duffing_env"), cache)
    claims = [
        Claim("import duffing_env", results["import duffing_env"].median, bar=0.7, at_most=True, unit="s"),
        Claim("torch or matplotlib in memory after import duffing_env", float(is_heavy == "True"),
              bar=0, at_most=True, unit=""),
        Claim(FIRST_WARM, results[FIRST_WARM].median, bar=1, at_most=True, unit="s"),
    ]  # fmt: skip
    notes = [
        "Each in a process of its own, without the start of Python itself. A first call is make_vec, reset and one "
        "step; peak memory is the resident set after more than one episode of all environments."
    ]
    return Section("Start-up", list(results.values()), claims, notes)


def _importing(package: str, cache: str) -> Callable[[int], tuple[float, float]]:
    return lambda _: (float(_script(_IMPORT.format(package=package), cache)[0]), 1)


def _cold(_: int) -> tuple[float, float]:
    with tempfile.TemporaryDirectory() as empty:
        return float(_script(_FIRST_CALL.format(size=1, steps=0), empty)[0]), 1


def _script(text: str, cache: str) -> list[str]:
    """Run a script in a fresh Python; its printed lines."""
    done = subprocess.run(
        [sys.executable, "-c", text], cwd=ROOT, env={**os.environ, "NUMBA_CACHE_DIR": cache},
        capture_output=True, text=True,
    )  # fmt: skip
    if done.returncode:
        raise RuntimeError(done.stderr.strip().splitlines()[-1])
    return done.stdout.split()
