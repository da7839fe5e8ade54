"""Section 7: time before the first step, and memory of many environments."""

import os
import subprocess
import sys
import tempfile
from collections.abc import Callable

from benchmarks.peer_process import ROOT
from benchmarks.section_tables import Claim, Section
from benchmarks.timed_rounds import Row, measure

#: Packages whose import is timed.
PACKAGES = ("estimator", "duffing_env", "agents", "gymnasium", "numba", "stable_baselines3")

#: Number of many environments.
MANY = 16384

#: Names of rows.
FIRST_COLD, FIRST_WARM = "import and first step, nothing cached", "import and first step, cached"
MEMORY, MEMORY_BARE = f"peak memory, {MANY:,} environments", "peak memory, 1 environment"

_IMPORT = """
import sys, time
started = time.perf_counter()
import {package}
print(time.perf_counter() - started)
print("torch" in sys.modules or "matplotlib" in sys.modules)
"""

# Time to a first step: imports, make, reset and one step.
_FIRST_STEP = """
import time
started = time.perf_counter()
import gymnasium, duffing_env
env = gymnasium.make("duffing_env/Amplitude-v0")
env.reset(seed=0)
env.step(env.action_space.sample())
print(time.perf_counter() - started)
"""

_MEMORY = """
import gymnasium, numpy, duffing_env
envs = gymnasium.make_vec("duffing_env/Amplitude-v0", num_envs={size}, vectorization_mode="vector_entry_point")
envs.reset(seed=0)
for _ in range(300):
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
    """Time imports and first steps, each in a fresh process."""
    said: list[list[str]] = []

    def cold(_: int) -> tuple[float, float]:
        with tempfile.TemporaryDirectory() as empty:
            printed, messages = _script(_FIRST_STEP, empty)
        said.append(messages)
        return float(printed[0]), 1

    def script(text: str, cache: str) -> Callable[[int], tuple[float, float]]:
        return lambda _: (float(_script(text, cache)[0][0]), 1)

    with tempfile.TemporaryDirectory() as cache:
        for text in (_FIRST_STEP, _MEMORY.format(size=1)):
            _script(text, cache)  # fills the cache
        rows = [
            Row(f"import {package}", "s", script(_IMPORT.format(package=package), cache), 0) for package in PACKAGES
        ]
        rows += [
            Row(FIRST_WARM, "s", script(_FIRST_STEP, cache), at_least=0),
            Row(FIRST_COLD, "s", cold, at_least=0),
            Row(MEMORY_BARE, "MiB", script(_MEMORY.format(size=1), cache), at_least=0),
            Row(MEMORY, "MiB", script(_MEMORY.format(size=MANY), cache), at_least=0),
        ]
        results = measure(rows, repetitions, on_row)
        (_, is_heavy), _ = _script(_IMPORT.format(package="duffing_env"), cache)
    claims = [
        Claim("import duffing_env", results["import duffing_env"].median, bar=0.7, at_most=True, unit="s"),
        Claim("torch or matplotlib in memory after import duffing_env", float(is_heavy == "True"),
              bar=0, at_most=True, unit=""),
        Claim(FIRST_WARM, results[FIRST_WARM].median, bar=0.7, at_most=True, unit="s"),
        Claim(FIRST_COLD, results[FIRST_COLD].median, bar=8, at_most=True, unit="s"),
        Claim("runs with nothing cached that do not say once that they compile",
              float(sum(len(lines) != 1 for lines in said)), bar=0, at_most=True, unit=""),
    ]  # fmt: skip
    notes = [
        "Each in a process of its own, without the start of Python itself. A first step is the import, gym.make, reset "
        "and one step; peak memory is the resident set after more than one episode of all environments.",
        *([f"With nothing cached it says:\n{said[-1][0]}"] if said and said[-1] else []),
    ]
    return Section("Start-up", list(results.values()), claims, notes)


def _script(text: str, cache: str) -> tuple[list[str], list[str]]:
    """Run a script in a fresh Python; return the words of its stdout and the lines of its stderr."""
    done = subprocess.run(
        [sys.executable, "-c", text], cwd=ROOT, env={**os.environ, "NUMBA_CACHE_DIR": cache},
        capture_output=True, text=True,
    )  # fmt: skip
    if done.returncode:
        raise RuntimeError(done.stderr.strip().splitlines()[-1])
    return done.stdout.split(), done.stderr.splitlines()
