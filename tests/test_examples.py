"""The examples: each trains on a few thousand samples, and its policy folder is played as any other.

TorchRL and RLlib are not in the lock of these tests: `make compat` runs theirs, in its own environment.
"""

import importlib.util
import json
import os
import runpy
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from tables import table

from agents.evaluation.policy_evaluation import evaluate_policies

ROOT = Path(__file__).parents[1]
#: Example to what it needs, the samples that it is trained on here, and what makes its roll-outs short enough.
LIBRARY = {
    "cleanrl_ppo": ("torch", 1024, ["--num-steps", "512"]),
    "torchrl_ppo": ("torchrl", 4096, []),
    "rllib_ppo": ("ray", 4096, []),
}


def in_a_process(name, *words):
    """Exit status and messages of an example that runs by itself."""
    command = [sys.executable, str(ROOT / "examples" / f"{name}.py"), *words]
    variables = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run(command, env=variables, capture_output=True, text=True, check=False)
    return done.returncode, done.stderr


@pytest.fixture
def example(tmp_path, monkeypatch, capsys):
    """Runs one in an empty folder, within this process, which has imported torch: returns status and messages."""
    monkeypatch.chdir(tmp_path)
    threads = torch.get_num_threads()

    def run(name, *words):
        monkeypatch.setattr(sys, "argv", [f"{name}.py", *words])
        status = 0
        try:
            runpy.run_path(str(ROOT / "examples" / f"{name}.py"), run_name="__main__")
        except SystemExit as stop:
            status = stop.code
        messages = capsys.readouterr().err
        return (1, f"{messages}{status}\n") if isinstance(status, str) else (status, messages)

    yield run
    torch.set_num_threads(threads)


@pytest.mark.parametrize("name", LIBRARY)
def test_an_example_trains_a_policy_that_is_played_as_any_other(name, example, tmp_path):
    library, steps, short = LIBRARY[name]
    if importlib.util.find_spec(library) is None:
        pytest.skip(f"{library} is not installed here; make compat runs this one")
    run = example if library == "torch" else in_a_process  # the others start threads and processes of their own
    folders = [tmp_path / number for number in ("one", "two")]
    for folder in folders:
        words = ["--total-timesteps", str(steps), "--seed", "3", "--output", str(folder), *short]
        status, messages = run(name, *words)
        assert status == 0, messages[-2000:]
    card = json.loads((folders[0] / "policy.json").read_text())
    assert 0.97 * steps <= card["steps"] <= 1.05 * steps
    assert (card["config"]["seed"], card["command"][0]) == (3, f"{name}.py")
    assert {"duffing-env", "gymnasium", "torch"} <= card["versions"].keys()
    one, two = ((folder / "policy.safetensors").read_bytes() for folder in folders)
    assert one == two  # the same seed, the same weights
    (found,) = evaluate_policies([str(folders[0])], env_id="duffing_env/Short-v0", systems=4)
    assert np.isfinite(found.metrics["information_gain"]).all()


@table(
    ("words", "message"),
    [
        (["--total-timesteps", "1000"], "total_timesteps must be at least a roll-out, 2048, but are 1000; take more"),
        (["--env-id", "Short-v7"], "Short"),
        (["--output", "taken"], "output must be a folder, but taken is a file; name another folder"),
        (["--output", "run"], "output must be a folder for a policy, but run holds a run; remove it or name another"),
    ],
)
def test_an_unusable_option_of_an_example_is_one_line_before_training(example, words, message):
    Path("taken").write_text("")
    Path("run").mkdir(exist_ok=True)
    Path("run/config.json").write_text("{}")
    status, messages = example("cleanrl_ppo", *words)
    assert status == 2
    reported = [line for line in messages.splitlines() if "is compiling" not in line]  # as it says on a slow machine
    assert len(reported) == 1
    assert message in reported[0]


@pytest.mark.parametrize(
    ("name", "first", "package"), [("torchrl_ppo", "tensordict", "torchrl"), ("rllib_ppo", "ray", "ray[rllib]")]
)
def test_a_library_that_is_missing_is_named(example, monkeypatch, name, first, package):
    # As if it were not installed, on machines that have it, too.
    Path(f"{first}.py").write_text(f"raise ModuleNotFoundError(name={first!r})")
    monkeypatch.delitem(sys.modules, first, raising=False)
    monkeypatch.syspath_prepend(Path.cwd())
    status, messages = example(name, "--help")
    assert status == 1
    assert messages.splitlines() == [messages.strip()]
    assert f"{first} is not installed; get it with: pip install" in messages
    assert package in messages
