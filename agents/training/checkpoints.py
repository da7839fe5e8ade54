"""Checkpoints: the policy on the way, and in the latest one the state of the training, from which it goes on.

The state is ``training.safetensors`` (weights, moments of the optimisers, the replay buffer where there is one, and the
moment that the training is in: episodes, streams of random numbers, and the last returns) and ``training.json`` (the
counts). With it a training that goes on from a checkpoint is the one that was never stopped, bit for bit.
"""

from __future__ import annotations

import json
import os
import shutil
import tempfile
from collections import deque
from dataclasses import asdict, dataclass, field
from operator import attrgetter
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from agents.policies.learned import WEIGHTS
from agents.policies.saving import write_policy
from estimator.files import whole_file, write_atomically, writing

if TYPE_CHECKING:
    from stable_baselines3.common.base_class import BaseAlgorithm

Tensors = dict[str, npt.NDArray[Any]]

FOLDER = "checkpoints"
STATE = "training.json"
TENSORS = "training.safetensors"
_HALF_WRITTEN = ".checkpoint-"
_ENTROPY = "log_ent_coef"  # the log weight of the entropy, of an algorithm that learns it
_BUFFER = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts")
_ENDED = ("r", "l", "t")
_NORMALIZER = ("normalizer.mean", "normalizer.std")


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
    with writing(target):
        target.parent.mkdir(parents=True, exist_ok=True)
        half_written = Path(tempfile.mkdtemp(dir=run, prefix=_HALF_WRITTEN))
    try:
        half_written.chmod(0o755)
        write_policy(half_written, model, card)
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
        found = json.loads(
            whole_file(checkpoint / STATE, "checkpoint must be whole", 2**28).read_text(encoding="utf-8")
        )
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
    except OSError as error:
        raise ValueError(f"begin must be the folder of a policy, but {folder} has no {WEIGHTS}; name one") from error
    for name in ("setting", *_NORMALIZER):
        tensors.pop(name, None)
    shapes, own = ({name: tuple(t.shape) for name, t in of.items()} for of in (tensors, model.policy.state_dict()))
    for name in sorted({*shapes, *own}):
        if shapes.get(name) != own.get(name):
            raise ValueError(
                f"begin must be a policy with the network of the training, but {folder} has {name} of shape "
                f"{shapes.get(name, 'none')} in place of {own.get(name, 'none')}; train with its hyperparameters"
            )
    model.policy.load_state_dict(tensors)
    _take_normalizer(folder, model)


def _take_normalizer(folder: Path, model: BaseAlgorithm) -> None:
    """Let the environments of a model normalise features as those of a policy did; nothing where it has none."""
    from safetensors.numpy import load_file

    envs: Any = model.get_env()
    tensors = load_file(folder / WEIGHTS)
    if hasattr(envs, "normalizer") and _NORMALIZER[0] in tensors:
        envs.normalizer.mean, envs.normalizer.std = (tensors[name].copy() for name in _NORMALIZER)


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
        _take_normalizer(checkpoint, model)  # which a run that was begun with a policy has from that
        tensors = {name: tensor.copy() for name, tensor in load_file(checkpoint / TENSORS).items()}
        for name in model.get_parameters():
            part = attrgetter(name)(model)
            own = {key: torch.from_numpy(tensor) for key, tensor in part_of(tensors, name).items()}
            part.load_state_dict(_moments(own, part) if isinstance(part, torch.optim.Optimizer) else own)
        if (entropy := getattr(model, _ENTROPY, None)) is not None:
            entropy.data.copy_(torch.from_numpy(tensors[_ENTROPY]))
        if (buffer := getattr(model, "replay_buffer", None)) is not None:
            _refill(buffer, part_of(tensors, "buffer"))
        go_on(model, part_of(tensors, "moment"))
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
    if (entropy := getattr(model, _ENTROPY, None)) is not None:
        tensors[_ENTROPY] = entropy.detach().cpu().numpy()
    if (buffer := getattr(model, "replay_buffer", None)) is not None:
        tensors |= {f"buffer/{name}": getattr(buffer, name)[: buffer.size()] for name in _BUFFER}
        tensors["buffer/position"] = np.array(buffer.pos)
    tensors |= {f"moment/{name}": array for name, array in moment_of(model).items()}
    try:
        save_file({name: np.array(tensor, order="C") for name, tensor in tensors.items()}, folder / TENSORS)
    except SafetensorError as error:  # of a full disk
        raise OSError(f"{folder / TENSORS} cannot be written: {error}; make room, then resume") from error
    write_atomically(folder / STATE, json.dumps(asdict(progress)))


def _moments(own: dict[str, Any], optimizer: Any) -> dict[str, Any]:
    """The state of an optimiser, from its tensors "PARAMETER/MOMENT"; its settings are those of the model."""
    state: dict[int, dict[str, Any]] = {}
    for key, tensor in own.items():
        index, moment = key.split("/")
        state.setdefault(int(index), {})[moment] = tensor
    return {"state": state, "param_groups": optimizer.state_dict()["param_groups"]}


def _refill(buffer: Any, tensors: Tensors) -> None:
    filled = len(tensors["rewards"])
    for name in _BUFFER:
        getattr(buffer, name)[:filled] = tensors[name]
    buffer.pos = int(tensors["position"])
    buffer.full = filled == buffer.buffer_size


def moment_of(model: BaseAlgorithm) -> Tensors:
    """The moment between an update and the next roll-out; nothing where the environments cannot be gone on with."""
    import torch

    envs: Any = model.get_env()
    if not hasattr(envs, "recall"):
        return {}
    numpys = np.random.get_state(legacy=False)  # noqa: NPY002  Stable-Baselines3 draws from it
    numpys["state"]["key"] = numpys["state"]["key"].tolist()
    streams = {"numpy": numpys, "actions": model.action_space.np_random.bit_generator.state}
    ended = [[episode[name] for name in _ENDED] for episode in model.ep_info_buffer or ()]
    return {
        "streams": np.frombuffer(json.dumps(streams).encode(), np.uint8),
        "torch": torch.get_rng_state().numpy(),
        "starts": np.asarray(model._last_episode_starts),
        "ended": np.array(ended, dtype=np.float64).reshape(-1, len(_ENDED)),
        "left": np.array(model._current_progress_remaining),
        **{f"lstm/{place}": value.numpy() for place, value in enumerate(_recurrent(model))},
        **{f"envs/{name}": array for name, array in envs.memory.items()},
    }


def go_on(model: BaseAlgorithm, moment: Tensors) -> None:
    """Put a model with new environments into the moment that another was in.

    Raises:
        KeyError, ValueError: where it is that of a model with other environments.
    """
    import torch

    if not moment:
        return
    envs: Any = model.get_env()
    model._last_obs = envs.recall(part_of(moment, "envs"))
    model._last_episode_starts = moment["starts"]
    model._current_progress_remaining = float(moment["left"])
    for place, value in enumerate(_recurrent(model)):
        value.copy_(torch.from_numpy(moment[f"lstm/{place}"]))
    ended = [dict(zip(_ENDED, row, strict=True)) for row in moment["ended"].tolist()]
    model.ep_info_buffer = deque(ended, maxlen=model._stats_window_size)
    model.ep_success_buffer = deque(maxlen=model._stats_window_size)
    streams = json.loads(moment["streams"].tobytes())
    np.random.set_state(streams["numpy"])  # noqa: NPY002
    model.action_space.np_random.bit_generator.state = streams["actions"]
    torch.set_rng_state(torch.from_numpy(moment["torch"]))


def part_of(tensors: Tensors, name: str) -> Tensors:
    """What is called "NAME/KEY", by its key."""
    return {key.removeprefix(f"{name}/"): array for key, array in tensors.items() if key.startswith(f"{name}/")}


def _recurrent(model: Any) -> list[Any]:
    """The memories (layers, n, units) of actor and critic, of a model that has one."""
    states = getattr(model, "_last_lstm_states", None)
    return [] if states is None else [value for part in states for value in part]
