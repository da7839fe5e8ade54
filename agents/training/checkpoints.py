"""Checkpoints: the policy on the way, and in the latest one the state of the training, from which it goes on.

The state is ``training.safetensors`` (weights, moments of the optimisers, the replay buffer where there is one, and
`agents.training.moments`) and ``training.json`` (the counts).
"""

from __future__ import annotations

import json
import os
import shutil
import tempfile
from dataclasses import asdict, dataclass, field
from operator import attrgetter
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from agents.policies.learned import WEIGHTS
from agents.policies.saving import save_policy
from agents.training.moments import Tensors, go_on, moment_of
from estimator.files import whole_file, write_atomically

if TYPE_CHECKING:
    from stable_baselines3.common.base_class import BaseAlgorithm

FOLDER = "checkpoints"
STATE = "training.json"
TENSORS = "training.safetensors"
_HALF_WRITTEN = ".checkpoint-"
_BUFFER = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts")


@dataclass
class Progress:
    """How far a training is: what ``training.json`` holds.

    Attributes:
        steps: samples so far.
        updates: gradient updates so far, as the algorithm counts them.
        episodes: episodes so far, as the algorithm counts them.
        seconds: of wall time so far.
        curve: (updates, 3) samples, seconds, mean return of the last episodes; None where none has ended.
    """

    steps: int = 0
    updates: int = 0
    episodes: int = 0
    seconds: float = 0.0
    curve: list[tuple[int, float, float | None]] = field(default_factory=list)


def save_checkpoint(run: Path, model: BaseAlgorithm, card: dict[str, Any], progress: Progress | None) -> None:
    """Write ``checkpoints/STEPS`` in one piece: under another name first, which is changed when all of it is there.

    Args:
        run: the run folder.
        model: the algorithm.
        card: of the policy, see `save_policy`.
        progress: of a training that is to go on from here; older checkpoints then lose their state. None: the policy
            alone.
    """
    target = run / FOLDER / f"{model.num_timesteps:09d}"
    target.parent.mkdir(parents=True, exist_ok=True)
    half_written = Path(tempfile.mkdtemp(dir=run, prefix=_HALF_WRITTEN))
    try:
        half_written.chmod(0o755)
        save_policy(half_written, model, card)
        if progress is not None:
            _save_state(half_written, model, progress)
        shutil.rmtree(target, ignore_errors=True)
        os.replace(half_written, target)
    finally:
        shutil.rmtree(half_written, ignore_errors=True)
    if progress is not None:
        drop_states(run, but=target)


def latest_checkpoint(run: Path) -> Path | None:
    """The latest checkpoint that a training can go on from; those that were never finished are removed."""
    for half_written in run.glob(f"{_HALF_WRITTEN}*"):
        shutil.rmtree(half_written)
    return max((state.parent for state in run.glob(f"{FOLDER}/*/{STATE}")), default=None)


def load_progress(checkpoint: Path) -> Progress:
    """How far the training was.

    Raises:
        ValueError: where the file is damaged.
    """
    try:
        found = json.loads(whole_file(checkpoint / STATE, "checkpoint must be whole", 2**28).read_text())
        return Progress(**{**found, "curve": [tuple(point) for point in found["curve"]]})
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise ValueError(f"checkpoint must hold a sound {STATE}, but {checkpoint} does not: {error!r}") from error


def begin_with(folder: Path, model: BaseAlgorithm) -> None:
    """Give a new model the network of a trained policy.

    Raises:
        ValueError: where it holds no policy, or that of another network.
    """
    import torch
    from safetensors.numpy import load_file

    try:
        tensors = {name: torch.from_numpy(t.copy()) for name, t in load_file(folder / WEIGHTS).items()}
        model.policy.load_state_dict({name: t for name, t in tensors.items() if name != "foresight"})
    except (OSError, RuntimeError) as error:
        raise ValueError(f"begin must be a policy with the network of the training, but {folder} is not") from error


def restore(checkpoint: Path, model: BaseAlgorithm) -> None:
    """Give a new model the weights, moments, buffer, counts and episodes that the checkpoint holds.

    Raises:
        ValueError: where the tensors are damaged or those of another model.
    """
    import torch
    from safetensors import SafetensorError
    from safetensors.numpy import load_file

    progress = load_progress(checkpoint)
    model.num_timesteps, model._n_updates = progress.steps, progress.updates
    model._episode_num = progress.episodes
    try:
        tensors = {name: tensor.copy() for name, tensor in load_file(checkpoint / TENSORS).items()}
        for name in model.get_parameters():
            part = attrgetter(name)(model)
            own = {key.removeprefix(f"{name}/"): torch.from_numpy(t) for key, t in tensors.items() if _of(name, key)}
            part.load_state_dict(_moments(own, part) if isinstance(part, torch.optim.Optimizer) else own)
        if (entropy := _entropy(model)) is not None:
            entropy.data.copy_(torch.from_numpy(tensors["log_ent_coef"]))
        if (buffer := _buffer(model)) is not None:
            _refill(buffer, tensors)
        go_on(model, {key.removeprefix("moment/"): t for key, t in tensors.items() if _of("moment", key)})
    except (KeyError, RuntimeError, ValueError, OSError, SafetensorError) as error:
        raise ValueError(f"checkpoint must hold this algorithm's state, but {checkpoint} does not: {error}") from error


def drop_states(run: Path, but: Path | None = None) -> None:
    """Remove the state from all checkpoints but one; their policies stay."""
    for state in run.glob(f"{FOLDER}/*/{STATE}"):
        if state.parent != but:
            state.unlink()
            (state.parent / TENSORS).unlink(missing_ok=True)


def _save_state(folder: Path, model: BaseAlgorithm, progress: Progress) -> None:
    import torch
    from safetensors import SafetensorError
    from safetensors.numpy import save_file

    tensors: Tensors = {}
    for name, part in model.get_parameters().items():
        if isinstance(attrgetter(name)(model), torch.optim.Optimizer):
            part = {f"{i}/{key}": value for i, moments in part["state"].items() for key, value in moments.items()}
        tensors |= {f"{name}/{key}": value.detach().cpu().numpy() for key, value in part.items()}
    if (entropy := _entropy(model)) is not None:
        tensors["log_ent_coef"] = entropy.detach().cpu().numpy()
    if (buffer := _buffer(model)) is not None:
        tensors |= {f"buffer/{name}": getattr(buffer, name)[: buffer.size()] for name in _BUFFER}
        tensors["buffer/position"] = np.array(buffer.pos)
    tensors |= {f"moment/{name}": array for name, array in moment_of(model).items()}
    try:
        save_file({name: np.array(tensor, order="C") for name, tensor in tensors.items()}, folder / TENSORS)
    except SafetensorError as error:  # of a full disk
        raise OSError(f"{folder / TENSORS} cannot be written: {error}; make room, then resume") from error
    write_atomically(folder / STATE, json.dumps(asdict(progress)))


def _entropy(model: BaseAlgorithm) -> Any:
    """The log weight of the entropy, of an algorithm that learns it."""
    return getattr(model, "log_ent_coef", None)


def _buffer(model: BaseAlgorithm) -> Any:
    """The replay buffer, of an algorithm that has one."""
    return getattr(model, "replay_buffer", None)


def _of(name: str, key: str) -> bool:
    """Whether a tensor's key belongs to the part of this name."""
    return key.startswith(f"{name}/")


def _moments(own: dict[str, Any], optimizer: Any) -> dict[str, Any]:
    """The state of an optimiser, from its tensors "PARAMETER/MOMENT"; its settings are those of the model."""
    state: dict[int, dict[str, Any]] = {}
    for key, tensor in own.items():
        index, moment = key.split("/")
        state.setdefault(int(index), {})[moment] = tensor
    return {"state": state, "param_groups": optimizer.state_dict()["param_groups"]}


def _refill(buffer: Any, tensors: Tensors) -> None:
    filled = len(tensors["buffer/rewards"])
    for name in _BUFFER:
        getattr(buffer, name)[:filled] = tensors[f"buffer/{name}"]
    buffer.pos = int(tensors["buffer/position"])
    buffer.full = filled == buffer.buffer_size
