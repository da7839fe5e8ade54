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


@pytest.mark.parametrize("name", LIBRARY)
def test_an_example_trains_a_policy_that_is_played_as_any_other(name, tmp_path):
    if importlib.util.find_spec(LIBRARY[name]) is None:
        pytest.skip(f"{LIBRARY[name]} is not installed here; make compat runs this one")
    folders = [tmp_path / run for run in ("one", "two")]
    for folder in folders:
        words = ["--total-timesteps", "4096", "--seed", "3", "--output", str(folder)]
        told = {**os.environ, "PYTHONPATH": str(ROOT)}
        command = [sys.executable, str(ROOT / "examples" / f"{name}.py"), *words]
        done = subprocess.run(command, cwd=tmp_path, env=told, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr[-2000:]
    card = json.loads((folders[0] / "policy.json").read_text())
    assert 4000 <= card["steps"] <= 4096 * 1.05
    assert (card["config"]["seed"], card["command"][0]) == (3, f"{name}.py")
    assert {"duffing-env", "gymnasium", "torch"} <= card["versions"].keys()
    one, two = ((folder / "policy.safetensors").read_bytes() for folder in folders)
    assert one == two  # the same seed, the same weights
    (found,) = evaluate([str(folders[0])], env_id="duffing_env/Short-v0", systems=4)
    assert np.isfinite(found.metrics["information_gain"]).all()
