"""Fuzzing of files of every format: truncated, with flipped bits, other arrays or entries, or other content."""

import io
import json
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from hypothesis import strategies as st

from agents.leaderboard import leaderboard_file
from agents.policies.networks.trained_policy import CARD_FILE, WEIGHTS_FILE, load_policy
from agents.training.checkpoints import STATE_FILE, TrainingProgress, load_progress
from agents.training.hyperparameters import HYPERPARAMETER_FOLDER, read_hyperparameters
from agents.training.training_config import TrainConfig, describe_run, read_config
from benchmarks.fuzz.bad_values import another_array, changed, damaged
from benchmarks.fuzz.call_verdicts import Call
from benchmarks.fuzz.fuzz_estimators import RIG, sound, started_estimator, suppress_overflow
from estimator import OnlineEstimator, Rig, load_estimator, save_estimator
from estimator.identification.data.record_files import read_record_file

#: A record of 60 samples.
_RECORD = b"time [s],force [N],displacement [m]\n" + b"".join(
    f"{k * 1e-3:.3f},{k % 7 - 3},{1e-3 * (k % 5)}\n".encode() for k in range(60)
)


def _go_on(path: Path) -> str:
    """Load an estimator, update it with 25 samples, and say what is wrong with its belief."""
    estimator: OnlineEstimator = load_estimator(path)
    scale = estimator.scales
    rng = np.random.default_rng(0)
    u, y = rng.standard_normal((2, 25))
    with suppress_overflow():
        estimator.run(0.1 * scale.input * u, 0.01 * scale.output * y)
    return sound(estimator)


def _act(folder: Path) -> str:
    """Load a policy and ask it for actions; say what is wrong with them."""
    policy = load_policy(folder)
    try:
        actions, _ = policy.predict(np.zeros((2, 22), dtype=np.float32), deterministic=True)
    except ValueError as error:  # a sound network for other observations
        if "observation must have" in str(error):
            return ""
        raise
    bounded = actions.shape == (2, 1) and np.isfinite(actions).all() and np.abs(actions).max() <= 1
    return "" if bounded else f"actions {actions!r}"


def _archive(arrays: dict[str, Any]) -> bytes:
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)
    return buffer.getvalue()


def calls() -> st.SearchStrategy[Call]:
    """Calls that read a file."""
    from safetensors.numpy import load_file, save

    place = Path(tempfile.mkdtemp(prefix="fuzz-"))
    shipped = Path(str(__import__("agents").__file__)).parent / "policies" / "trained" / "ppo" / "short"
    card, tensors = json.loads((shipped / CARD_FILE).read_text()), load_file(shipped / WEIGHTS_FILE)
    kinds = ("paper", "look-ahead", "ensemble", "rig")
    estimators = {}
    for name in kinds:
        save_estimator(started_estimator(name), place / "estimator.npz")
        with np.load(place / "estimator.npz") as archive:
            estimators[name] = ((place / "estimator.npz").read_bytes(), {key: archive[key] for key in archive.files})
    matlab = io.BytesIO()
    __import__("scipy.io").io.savemat(matlab, {"u": np.arange(60.0), "y": np.sin(np.arange(60.0))})
    entries = leaderboard_file.SHIPPED_LEADERBOARD.read_text().splitlines()[:2]
    config = json.dumps(describe_run(TrainConfig()), default=str)
    progress = json.dumps(vars(TrainingProgress(steps=5, curve=[(1, 0.5, None)])))
    fields = ("config", *TrainConfig.__dataclass_fields__, "hyperparameter")
    settings, board = (HYPERPARAMETER_FOLDER / "ppo.toml").read_bytes(), "\n".join(entries).encode()
    # By format: the file's name, its content, its reader, words of clear messages, and JSON in which to change a place.
    others: dict[str, tuple[str, bytes, Callable[[Path], Any], tuple[str, ...], str]] = {
        "rig": ("file", RIG.to_toml().encode(), Rig.from_file, (), ""),
        "csv": ("record.csv", _RECORD, lambda path: read_record_file(path, RIG), (), ""),
        "mat": ("record.mat", matlab.getvalue(), lambda path: read_record_file(path, RIG), (), ""),
        "run": ("config.json", config.encode(), lambda path: read_config(path.parent), fields, config),
        "checkpoint": (
            STATE_FILE, progress.encode(), lambda path: load_progress(path.parent), ("checkpoint",), progress,
        ),
        "settings": (
            "file", settings, lambda path: read_hyperparameters("ppo", "duffing_env/Short-v0", path),
            ("settings", "hyperparameter"), "",
        ),
        "board": (
            "file", board, lambda path: leaderboard_file.leaderboard_rows(leaderboard_file.read_entries(path)),
            ("board",), entries[0],
        ),
    }  # fmt: skip
    counter = iter(range(10**9))

    @st.composite
    def call(draw: st.DrawFn) -> Call:
        kind = draw(st.sampled_from(["estimator"] * 3 + ["policy", *others]))
        number = next(counter) % 4
        if kind == "mat" and draw(st.integers(0, 9)):  # each takes a process
            kind = "csv"
        folder = place / f"{kind}{number}"
        folder.mkdir(exist_ok=True)
        name, whole, reads, words, held = others.get(kind, ("file", b"", None, (), ""))
        path = folder / name
        names: tuple[str, ...] = ("path", "rig", "record", "policy", str(path))
        if kind == "estimator":
            known, arrays = estimators[draw(st.sampled_from(kinds))]
            change = draw(st.integers(0, 2))
            if change == 0:
                content = draw(damaged(known))
            elif change == 1:
                key = draw(st.sampled_from(sorted(arrays)))
                content = _archive({**arrays, key: draw(another_array(arrays[key]))})
            else:
                described = draw(changed(json.loads(arrays["description"].tobytes())))
                text = np.frombuffer(json.dumps(described).encode(), dtype=np.uint8)
                content = _archive({**arrays, "description": text})
            path.write_bytes(content)
            return Call("load_estimator", lambda: _go_on(path), names, sound=str)
        if kind == "policy":
            change = draw(st.integers(0, 3))
            weights, described = dict(tensors), card
            if change == 0:
                key = draw(st.sampled_from(sorted(weights)))
                other = draw(another_array(weights[key]))
                if np.asarray(other).dtype.str[1:] in ("f4", "f8", "i8", "b1"):
                    weights[key] = np.ascontiguousarray(other, dtype=np.asarray(other).dtype.newbyteorder("="))
            elif change == 1:
                described = draw(
                    changed({name: card[name] for name in ("format", "network", "features") if name in card})
                )
            (folder / WEIGHTS_FILE).write_bytes(draw(damaged(save(weights))) if change == 2 else save(weights))
            (folder / CARD_FILE).write_bytes(
                draw(damaged(json.dumps(card).encode())) if change == 3 else json.dumps(described).encode()
            )
            return Call("load_policy", lambda: _act(folder), names, sound=str)
        described = draw(changed(json.loads(held))) if held else None
        is_damaged = draw(st.booleans()) if held else True
        path.write_bytes(draw(damaged(whole)) if is_damaged else json.dumps(described).encode())
        return Call(f"read a {kind}", lambda: reads(path), (*names, *words))

    return call()
