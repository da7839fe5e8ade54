"""Registration, and what importing the package costs."""

import subprocess
import sys

import gymnasium as gym
import pytest
from gymnasium.envs.registration import registry

from duffing_env import TRACKS, register_tracks


def run(code):
    """Run Python code in a process of its own; gives what it printed."""
    done = subprocess.run([sys.executable, "-W", "error", "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


def test_registration_is_idempotent():
    specs = {track: registry[track] for track in TRACKS}
    register_tracks()
    assert all(registry[track] is spec for track, spec in specs.items())


def test_registration_brings_back_what_was_taken_away():
    track = "duffing_env/Amplitude-v0"
    spec = registry.pop(track)
    register_tracks()
    assert registry[track] == spec


@pytest.mark.parametrize("track", TRACKS)
def test_specifications(track):
    spec = gym.spec(track)
    assert spec.namespace == "duffing_env"
    assert spec.kwargs == TRACKS[track]["kwargs"]
    assert spec.vector_entry_point == TRACKS[track]["vector_entry_point"]
    # A time limit of Gymnasium would cut a longer horizon short.
    assert spec.max_episode_steps is None


def test_the_amplitude_track_is_the_default_experiment():
    made = gym.make("duffing_env/Amplitude-v0").unwrapped
    assert made.experiment == type(made)().experiment


def test_names_with_the_module_work_in_processes_that_have_not_imported_it():
    code = "import gymnasium as gym; env = gym.make('duffing_env:duffing_env/Amplitude-v0'); print(env.spec.id)"
    assert run(code) == "duffing_env/Amplitude-v0"
    assert gym.make("duffing_env:duffing_env/Amplitude-v0").unwrapped.horizon == 256


def test_no_version_of_a_track_is_out_of_date():
    """They are different tasks: Gymnasium warns of none, without a filter of warnings."""
    code = """
import warnings
import gymnasium as gym
before = list(warnings.filters)
import duffing_env
print(gym.make("duffing_env/Short-v0").spec.id, gym.make_vec("duffing_env/Short-v0", num_envs=2).spec.id)
print(warnings.filters == before)
"""
    assert run(code).split() == ["duffing_env/Short-v0", "duffing_env/Short-v0", "True"]
    with pytest.raises(gym.error.NameNotFound, match="Did you mean: `Short-v"):
        gym.make("duffing_env/Short")


def test_importing_the_package_registers_the_tracks():
    code = (
        "import duffing_env, gymnasium; print([name for name in gymnasium.registry if name.startswith('duffing_env/')])"
    )
    assert run(code) == str(list(TRACKS))


def test_importing_the_package_is_light():
    code = """
import sys
import duffing_env
print(sorted({"torch", "matplotlib", "numba", "scipy", "pygame"} & set(sys.modules)))
"""
    assert run(code) == "[]"


def test_an_environment_needs_neither_torch_nor_matplotlib():
    code = """
import sys
import gymnasium as gym
env = gym.make("duffing_env:duffing_env/Amplitude-v0")
env.reset(seed=0)
env.step(env.action_space.sample())
print(sorted({"torch", "matplotlib", "stable_baselines3", "pygame"} & set(sys.modules)))
"""
    assert run(code) == "[]"
