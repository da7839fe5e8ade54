"""Threads and processes: environments in parallel give the same results as one after the other."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]

PLAY = """
import hashlib, os, sys, threading, warnings
import gymnasium as gym
import numpy as np
from gymnasium.vector import AsyncVectorEnv, SyncVectorEnv
import duffing_env
from duffing_env.vector_env import DuffingVectorEnv

def play(rows, seed, threads=1, steps=40):
    "The digest of all that an environment gave."
    envs, digest = DuffingVectorEnv(rows, threads=threads, horizon=16), hashlib.sha256()
    rng = np.random.default_rng(seed)
    envs.reset(seed=seed)
    for _ in range(steps):
        for given in envs.step(rng.uniform(-1, 1, (rows, 1)).astype(np.float32))[:4]:
            digest.update(np.ascontiguousarray(given))
    return digest.hexdigest()

def make():
    return gym.make("duffing_env/Short-v0")

def gather(kind, workers):
    "All that single environments in a vector of Gymnasium's gave."
    envs = kind([make] * workers)
    results = [envs.reset(seed=5)[0]]
    actions = np.random.default_rng(0).uniform(-1, 1, (40, workers, 1)).astype(np.float32)
    for action in actions:
        results += envs.step(action)[:4]
    envs.close()
    return [np.array(given) for given in results]
"""


def run(program, **variables):
    """The stdout of a program in a process of its own."""
    finished = subprocess.run(
        [sys.executable, "-c", PLAY + program], capture_output=True, text=True, cwd=ROOT, env=os.environ | variables
    )
    assert finished.returncode == 0, finished.stderr
    return finished.stdout.split()


@pytest.mark.parametrize("context", ["fork", pytest.param("spawn", marks=pytest.mark.slow)])
def test_sixteen_workers_are_one_process(context, tmp_path):
    if context == "fork" and not hasattr(os, "fork"):
        pytest.skip("this system cannot fork")
    path = tmp_path / "workers.py"  # spawn imports it
    path.write_text(
        PLAY + "from functools import partial\nif __name__ == '__main__':\n"
        "    warnings.simplefilter('ignore', DeprecationWarning)  # of a fork beside threads, since Python 3.12\n"
        f"    ours = gather(partial(AsyncVectorEnv, context={context!r}), 16)\n"
        "    assert all(map(np.array_equal, ours, gather(SyncVectorEnv, 16)))\n    print(len(ours))\n"
    )
    finished = subprocess.run(
        [sys.executable, path], capture_output=True, text=True, env=os.environ | {"PYTHONPATH": str(ROOT)}
    )
    assert finished.returncode == 0, finished.stderr
    assert finished.stdout.split() == ["161"]


@pytest.mark.parametrize("layer", ["default", "workqueue"])
def test_eight_threads_with_environments_of_their_own(layer):
    """Numba's simplest threads end a process that enters them from two of Python's at once."""
    program = """
import numba
for threads in (1, 2):
    found = {}
    def work(seed):
        found[seed] = play(70, seed, threads)
    workers = [threading.Thread(target=work, args=(seed,)) for seed in range(8)]
    for worker in workers: worker.start()
    for worker in workers: worker.join()
    print(*(found[seed] for seed in range(8)), *(play(70, seed) for seed in range(8)))
print(numba.threading_layer())
# GNU's threads end a child that uses them: it is stepped by one thread.
expected, forked = play(70, 3, 2), True
if hasattr(os, 'fork'):
    warnings.simplefilter('ignore', DeprecationWarning)
    child = os.fork()
    if child == 0:
        os._exit(0 if play(70, 3, 2) == expected else 1)
    forked = os.waitpid(child, 0)[1] == 0
print(forked, play(70, 3, 2) == expected)
"""
    *results, used, forked, afterwards = run(program, NUMBA_THREADING_LAYER=layer, NUMBA_NUM_THREADS="2")
    for some in (results[:16], results[16:]):
        assert some[:8] == some[8:]
        assert len(set(some)) == 8
    assert used in ("omp", "tbb", "workqueue")  # else all this would hold of one thread alone
    assert (forked, afterwards) == ("True", "True")


@pytest.mark.slow
def test_three_processes_that_compile_at_once_agree(tmp_path):
    """With an empty cache, which a fourth then reads."""
    variables = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path)}
    command = [sys.executable, "-c", PLAY + "print(play(70, 3))"]
    running = [
        subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=ROOT, env=variables)
        for _ in range(3)
    ]
    said = [each.communicate(timeout=1800) for each in running]
    assert [each.returncode for each in running] == [0, 0, 0], said
    assert {printed.strip() for printed, _ in said} == set(run("print(play(70, 3))"))
    assert not [path for path in tmp_path.iterdir() if path.name.startswith(".")]
    finished = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, env=variables)
    assert finished.stdout == said[0][0]
    assert finished.stderr == ""
