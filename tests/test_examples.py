"""The examples: each trains on a few thousand samples, and its policy folder is played as any other.

TorchRL and RLlib are not in the lock of these tests: `make compat` runs theirs, in its own environment.
"""

import importlib.util
import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from agents.evaluation.rollout import evaluate

ROOT = Path(__file__).parents[1]
LIBRARY = {"cleanrl_ppo": "torch", "torchrl_ppo": "torchrl", "rllib_ppo": "ray"}


def example(name, *words, folder):
    """Its exit status and messages; what lies in the folder is imported before what is installed."""
    command = [sys.executable, str(ROOT / "examples" / f"{name}.py"), *words]
    told = {**os.environ, "PYTHONPATH": f"{folder}{os.pathsep}{ROOT}"}
    done = subprocess.run(command, cwd=folder, env=told, capture_output=True, text=True, check=False)
    return done.returncode, done.stderr


@pytest.mark.parametrize("name", LIBRARY)
def test_an_example_trains_a_policy_that_is_played_as_any_other(name, tmp_path):
    if importlib.util.find_spec(LIBRARY[name]) is None:
        pytest.skip(f"{LIBRARY[name]} is not installed here; make compat runs this one")
    folders = [tmp_path / run for run in ("one", "two")]
    for folder in folders:
        words = ["--total-timesteps", "4096", "--seed", "3", "--output", str(folder)]
        status, messages = example(name, *words, folder=tmp_path)
        assert status == 0, messages[-2000:]
    card = json.loads((folders[0] / "policy.json").read_text())
    assert 4000 <= card["steps"] <= 4096 * 1.05
    assert (card["config"]["seed"], card["command"][0]) == (3, f"{name}.py")
    assert {"duffing-env", "gymnasium", "torch"} <= card["versions"].keys()
    one, two = ((folder / "policy.safetensors").read_bytes() for folder in folders)
    assert one == two  # the same seed, the same weights
    (found,) = evaluate([str(folders[0])], env_id="duffing_env/Short-v0", systems=4)
    assert np.isfinite(found.metrics["information_gain"]).all()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--total-timesteps", "1000"], "total_timesteps must be at least a roll-out, 2048, but are 1000; take more"),
        (["--env-id", "Short-v7"], "Short"),
        (["--output", "taken"], "output must be a folder, but taken is a file; name another place"),
        (["--output", "run"], "output must be a folder for a policy, but run holds a run; remove it or name another"),
    ],
)
def test_what_an_example_cannot_do_is_one_line_before_it_trains(tmp_path, words, message):
    (tmp_path / "taken").write_text("")
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "config.json").write_text("{}")
    status, messages = example("cleanrl_ppo", *words, folder=tmp_path)
    assert status == 2
    told = [line for line in messages.splitlines() if "is compiling" not in line]  # as it says on a slow machine
    assert len(told) == 1
    assert message in told[0]


@pytest.mark.parametrize(
    ("name", "first", "package"), [("torchrl_ppo", "tensordict", "torchrl"), ("rllib_ppo", "ray", "ray[rllib]")]
)
def test_a_library_that_is_missing_is_named(tmp_path, name, first, package):
    # As if it were not installed, on machines that have it, too.
    (tmp_path / f"{first}.py").write_text(f"raise ModuleNotFoundError(name={first!r})")
    status, messages = example(name, "--help", folder=tmp_path)
    assert status == 1
    assert messages.splitlines() == [messages.strip()]
    assert f"{first} is not installed; get it with: pip install" in messages
    assert package in messages
