"""What a user installs: the wheel in a clean environment, without torch; it takes the dependencies from the index."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
MOST = 600  # MB

#: Steps and identifies with README's lines, and plays what ships, with what the wheel brings alone.
TRIED = """
import doctest, json, re, sys
from importlib.util import find_spec
from pathlib import Path
assert not [name for name in ("torch", "stable_baselines3", "matplotlib") if find_spec(name)]
text = Path(sys.argv[1]).read_text()
(record,) = re.findall(r"```python\\n(import numpy.*?)```", text, re.DOTALL)
exec(record, {})
test = doctest.DocTestParser().get_doctest(text, {}, "README", "README", 0)
print(doctest.DocTestRunner(optionflags=doctest.REPORT_ONLY_FIRST_FAILURE).run(test).attempted, "lines of README")
import gymnasium as gym, numpy as np
from agents import make_policy
from agents.policies import TRAINED, trained_policies
import agents
assert Path(agents.__file__).is_relative_to(sys.prefix)
for name in trained_policies():
    track = json.loads((TRAINED / name / "policy.json").read_text())["track"]
    track = track if "/" in track else "duffing_env/Short-v0"
    envs = gym.make_vec(track, num_envs=8, vectorization_mode="vector_entry_point")
    policy, (observations, _) = make_policy(name, envs), envs.reset(seed=0)
    for _ in range(3):
        observations, rewards, *_ = envs.step(policy.predict(observations, deterministic=True)[0])
    assert np.isfinite(rewards).all(), name
print("played")
"""


def interpreter(version):
    """The Python of a version: the one that runs the tests, or one on the path; a test without one is skipped."""
    if version == f"{sys.version_info.major}.{sys.version_info.minor}":
        return sys.executable
    found = shutil.which(f"python{version}")
    if found is None or subprocess.run([found, "-c", ""], capture_output=True).returncode:
        pytest.skip(f"python{version} is not on the path")
    return found


@pytest.mark.slow
@pytest.mark.parametrize("version", ["3.11", "3.12", "3.13", "3.14"])
def test_a_clean_installation_is_light_and_works(version, tmp_path):
    python = interpreter(version)
    alone = {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}

    def run(*words, check=True):
        return subprocess.run(
            list(map(str, words)), cwd=tmp_path, env=alone, capture_output=True, text=True, check=check, timeout=1800
        )

    subprocess.run(
        [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", tmp_path], cwd=ROOT, check=True, timeout=600
    )
    run(python, "-m", "venv", tmp_path / "venv")
    (wheel,) = tmp_path.glob("*.whl")
    python = tmp_path / "venv" / "bin" / "python"
    done = run(python, "-m", "pip", "install", "--quiet", wheel, check=False)
    assert done.returncode == 0, done.stderr
    tried = run(python, "-c", TRIED, ROOT / "README.md", check=False)
    assert tried.returncode == 0, tried.stdout + tried.stderr
    assert tried.stdout.splitlines()[-1] == "played"
    assert "***Test Failed***" not in tried.stdout
    (installed,) = (tmp_path / "venv" / "lib").glob("*/site-packages")
    size = sum(path.stat().st_size for path in installed.rglob("*") if path.is_file()) / 2**20
    print(f"{wheel.name}, Python {version}: {size:.0f} MB in site-packages, with pip, bytecode and compiled kernels")
    assert size <= MOST
    trained = run(tmp_path / "venv" / "bin" / "duffing-env", "train", "--output", "out", check=False)
    assert trained.returncode == 2
    assert trained.stderr.splitlines()[-1].endswith("get it with: pip install 'duffing-env[train]'")
