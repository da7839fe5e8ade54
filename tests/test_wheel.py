"""What a user installs: the wheel in clean environments, without torch; it takes the dependencies from the index."""

import os
import shutil
import subprocess
import sys
import tomllib
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


def pythons():
    """Supported version to its Python: the one that runs the tests, and those on the path."""
    classifiers = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["classifiers"]
    versions = [
        word.split(" :: ")[-1] for word in classifiers if word.startswith("Programming Language :: Python :: 3.")
    ]
    found = {version: shutil.which(f"python{version}") for version in versions}
    found["{}.{}".format(*sys.version_info)] = sys.executable
    # A name on the path may belong to a version that is not installed (pyenv).
    return {
        version: python if python and not subprocess.run([python, "-c", ""], capture_output=True).returncode else None
        for version, python in found.items()
    }


@pytest.mark.slow
def test_clean_installations_are_light_and_work(tmp_path):
    subprocess.run(
        [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", tmp_path], cwd=ROOT, check=True, timeout=600
    )
    (wheel,) = tmp_path.glob("*.whl")
    for version, python in pythons().items():
        if python is None:
            print(f"Python {version}: not tried, for it is not on the path")
            continue
        size = installed_size(wheel, python, tmp_path / version)
        print(f"Python {version}: {size:.0f} MB in site-packages, with pip, bytecode and compiled kernels")
        assert size <= MOST


def installed_size(wheel, python, folder):
    """Size [MB] of the wheel in an environment of its own, after its functions were tried there."""
    alone = {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}
    folder.mkdir()

    def run(*words, check=True):
        return subprocess.run(
            list(map(str, words)), cwd=folder, env=alone, capture_output=True, text=True, check=check, timeout=1800
        )

    run(python, "-m", "venv", folder / "venv")
    bin = folder / "venv" / "bin"
    done = run(bin / "python", "-m", "pip", "install", "--quiet", wheel, check=False)
    assert done.returncode == 0, done.stderr
    tried = run(bin / "python", "-c", TRIED, ROOT / "README.md", check=False)
    assert tried.returncode == 0, tried.stdout + tried.stderr
    assert tried.stdout.splitlines()[-1] == "played"
    assert "***Test Failed***" not in tried.stdout
    trained = run(bin / "duffing-env", "train", "--output", "out", check=False)
    assert trained.returncode == 2
    assert trained.stderr.splitlines()[-1].endswith("get it with: pip install 'duffing-env[train]'")
    (installed,) = (folder / "venv" / "lib").glob("*/site-packages")
    return sum(path.stat().st_size for path in installed.rglob("*") if path.is_file()) / 2**20
