"""Write the results of one version of this project into an archive of arrays, as a child of `benchmarks.regression`.

It runs in that version's tree, so it uses only public names that every version has.
"""

import contextlib
import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

import duffing_env
from agents.policies import make_policy, trained_policies
from estimator import Rig, identify

#: Environments side by side: more than one block of lanes, and one that is not full.
SIZE = 11
#: Steps of each comparison, in samples: enough for an episode's end on the short tracks.
STEPS = 60
#: Track on which each kind of policy decides, where its own card names none.
TRACKS_OF_EFE = (
    "duffing_env/Amplitude-v0",
    "duffing_env/Amplitude-v1",
    "duffing_env/Power-v0",
    "duffing_env/Output-v1",
)
RIGS = ("silverbox", "beam", "electronic-duffing", "electronic-duffing-two-wells", "electronic-duffing-velocity")


def episodes(track: str) -> dict[str, Any]:
    """One environment alone, and several side by side, under random actions."""
    options = {"rig": "beam"} if track.endswith("Rig-v0") else {}
    env: Any = gym.make(track, **options)
    actions = np.random.default_rng(0).uniform(-1, 1, (STEPS, SIZE, 1)).astype(np.float32)
    observation, _ = env.reset(seed=1)
    single = [np.append(observation, 0.0)]
    for action in actions[:, 0]:
        observation, reward, terminated, truncated, _ = env.step(action)
        single.append(np.append(observation, reward))
        if terminated or truncated:
            env.reset()
    envs: Any = gym.make_vec(track, SIZE, vectorization_mode="vector_entry_point", **options)
    observations, _ = envs.reset(seed=2)
    batch = [np.append(observations.ravel(), np.zeros(SIZE))]
    for action in actions:
        observations, rewards, *_ = envs.step(action)
        batch.append(np.append(observations.ravel(), rewards))
    return {"single": np.array(single), "batch": np.array(batch)}


def record_of(rig: Rig) -> tuple[Any, Any]:
    """Simulate an input (600,) and the output (600,) of a rig in its units, by small explicit steps of its guess."""
    rng = np.random.default_rng(3)
    middle = {name: float(np.mean(interval)) for name, interval in (rig.guess or {}).items()}
    m, c, a, b = (middle.get(name, default) for name, default in zip("mcab", (1.7e-5, 2.8e-4, 1.0, 4.0), strict=True))
    u = 0.3 * (rig.inputs["u"].limit or 0.1) * np.repeat(rng.choice([-1.0, 1.0], 150), 4)
    x = 0.0 if a > 0 else float(np.sqrt(-a / b))
    v, seen = 0.0, []
    fine = 200
    for force in u:
        seen.append(v if rig.output.kind == "velocity" else x)
        for _ in range(fine):
            v += rig.step / fine / m * (force - c * v - a * x - b * x**3)
            x += rig.step / fine * v
    y = np.array(seen)
    return u, y + 0.01 * y.std() * rng.standard_normal(len(y))


def identified(name: str) -> dict[str, Any]:
    """Results of `identify` on a record of a shipped rig: every parameter, its standard deviation, and the warnings."""
    rig = Rig.silverbox("zero_order", 0) if name == "silverbox" else Rig.shipped(name)
    result = identify(rig, record_of(rig))
    return {
        "parameters": np.array([pair for _, pair in sorted(result.parameters.items())], float),
        "number of warnings": np.array(len(result.warnings)),
        "covariance of the physical parameters": np.array(result.belief.physical()[1]),
    }


def decisions(policy: str, track: str) -> dict[str, Any]:
    """Actions of a policy, and their rewards."""
    envs: Any = gym.make_vec(track, SIZE, vectorization_mode="vector_entry_point")
    chooser = make_policy(policy, envs, seed=0)
    observations, _ = envs.reset(seed=4)
    state, start, rows = None, np.ones(SIZE, bool), []
    for _ in range(STEPS):
        actions, state = chooser.predict(observations, state, start, deterministic=True)
        observations, rewards, terminated, truncated, _ = envs.step(actions)
        start = terminated | truncated
        rows.append(np.append(np.ravel(actions), rewards))
    return {"actions and rewards": np.array(rows)}


def reproduced(tree: Path, folder: Path) -> dict[str, Any]:
    """The numbers of ``reproduce.py``, apart from times."""
    written = folder / "reproduced.json"
    command = [sys.executable, "reproduce.py", "--json", written, "--figures", folder / "figures"]
    subprocess.run(command, cwd=tree, check=True, stdout=subprocess.DEVNULL)
    return {name: np.array(value) for name, value in numbers(json.loads(written.read_text()))}


def numbers(value: Any, name: str = "") -> Iterator[tuple[str, float]]:
    """Every number of a JSON document with its place, apart from times, versions and paths."""
    if isinstance(value, dict):
        for key, one in value.items():
            if not any(word in key for word in ("second", "time", "version", "duration")):
                yield from numbers(one, f"{name}.{key}")
    elif isinstance(value, list):
        for index, one in enumerate(value):
            yield from numbers(one, f"{name}.{index}")
    elif isinstance(value, float | int) and not isinstance(value, bool):
        yield name, float(value)


def card_track(policy: str) -> str:
    """Track of a shipped policy's training."""
    from agents.policies import TRAINED

    track = json.loads((TRAINED / policy / "policy.json").read_text())["config"]["env"]
    return track if track in duffing_env.TRACKS else "duffing_env/Amplitude-v1"


def main(tree: Path, archive: Path) -> None:
    """Compute all rows and write them."""
    rows: dict[str, dict[str, Any]] = {}

    def add(name: str, values: dict[str, Any]) -> None:
        rows[name] = values
        print(name, file=sys.stderr)

    for track in duffing_env.TRACKS:
        with contextlib.suppress(FileNotFoundError):  # a recorded track without its record
            add(f"episodes {track}", episodes(track))
    for rig in RIGS:
        add(f"identify {rig}", identified(rig))
    for track in TRACKS_OF_EFE:
        add(f"efe {track}", decisions("efe", track))
    for policy in trained_policies():
        add(f"decide {policy}", decisions(policy, card_track(policy)))
    with contextlib.suppress(subprocess.CalledProcessError):  # without the record
        add("reproduce.py", reproduced(tree, archive.parent))
    flat = {f"{row}|{name}": value for row, values in rows.items() for name, value in values.items()}
    np.savez(archive, **flat)


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
