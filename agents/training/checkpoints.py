"""Checkpoints of a training: the policy so far, and in the latest one the whole state, from which a run resumes.

The state is ``training.safetensors`` (weights, moments of the optimisers, the replay buffer where there is one, and
between two roll-outs: episodes, streams of random numbers, and the last returns) and ``training.json`` (the counts).
A training that goes on from a checkpoint equals the training without a stop, bit for bit.
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
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol, runtime_checkable

import numpy as np
import numpy.typing as npt

from agents.policies.networks.policy_saving import write_policy
from agents.policies.networks.trained_policy import WEIGHTS_FILE
from estimator.support.file_io import check_readable_file, explain_write_errors, write_atomically

if TYPE_CHECKING:
    from stable_baselines3.common.base_class import BaseAlgorithm
    from stable_baselines3.common.vec_env.base_vec_env import VecEnvObs

    from agents.training.environments.feature_vec_env import FeatureNormalizer

#: Name to array, as a safetensors file holds them.
TensorDict = dict[str, npt.NDArray[Any]]

#: Folder of the checkpoints, in a run folder.
CHECKPOINTS_FOLDER = "checkpoints"

#: Counts of a training, in its latest checkpoint.
STATE_FILE = "training.json"

#: Arrays of a training, in its latest checkpoint.
TENSORS_FILE = "training.safetensors"

#: Begins the name of a checkpoint that is being written.
_PARTIAL_PREFIX = ".checkpoint-"

#: Attribute of an algorithm that learns the weight of the entropy: the logarithm of this weight.
_LOG_ENTROPY_WEIGHT = "log_ent_coef"

#: Arrays of a replay buffer.
_BUFFER_ARRAYS = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts")

#: Return, length and time of an episode, as Stable-Baselines3 names them.
_EPISODE_KEYS = ("r", "l", "t")

#: Tensors of the normaliser in a policy's file.
_NORMALIZER_TENSORS = ("normalizer.mean", "normalizer.std")


@runtime_checkable
class _NormalizedEnvs(Protocol):
    """Environments with normalised features."""

    normalizer: FeatureNormalizer


@runtime_checkable
class _ResumableEnvs(Protocol):
    """Environments whose episodes can be saved and restored."""

    @property
    def episode_state(self) -> TensorDict: ...
    def restore_episode_state(self, memory: TensorDict) -> VecEnvObs: ...


class LearningPoint(NamedTuple):
    """A point of a learning curve.

    Attributes:
        steps: samples so far.
        seconds: of wall time so far.
        mean_return: of the last episodes; None where no episode has ended.
    """

    steps: int
    seconds: float
    mean_return: float | None


@dataclass
class TrainingProgress:
    """Counts of a training, the content of ``training.json``.

    Attributes:
        steps: samples so far.
        updates: gradient updates so far, as the algorithm counts them.
        episodes: episodes so far, as the algorithm counts them.
        seconds: of wall time so far.
        curve: a point for every update.
    """

    steps: int = 0
    updates: int = 0
    episodes: int = 0
    seconds: float = 0.0
    curve: list[LearningPoint] = field(default_factory=list)


def save_checkpoint(
    run_folder: Path, model: BaseAlgorithm, card: dict[str, Any], progress: TrainingProgress | None
) -> None:
    """Write ``checkpoints/STEPS`` in one piece: under another name first, and renamed when it is complete.

    Args:
        run_folder: the run folder.
        model: the algorithm.
        card: of the policy, see `save_policy`.
        progress: of a training that can go on from here; older checkpoints then lose their state. None: the checkpoint
            holds the policy alone.
    """
    target = run_folder / CHECKPOINTS_FOLDER / f"{model.num_timesteps:09d}"
    with explain_write_errors(target):
        target.parent.mkdir(parents=True, exist_ok=True)
        partial = Path(tempfile.mkdtemp(dir=run_folder, prefix=_PARTIAL_PREFIX))
    try:
        partial.chmod(0o755)
        write_policy(partial, model, card)
        if progress is not None:
            _save_training_state(partial, model, progress)
        shutil.rmtree(target, ignore_errors=True)
        os.replace(partial, target)
    finally:
        shutil.rmtree(partial, ignore_errors=True)
    if progress is not None:
        delete_training_states(run_folder, keep=target)


def latest_checkpoint(run_folder: Path) -> Path | None:
    """The latest checkpoint with the state of the training, or None; partly written checkpoints are removed."""
    for partial in run_folder.glob(f"{_PARTIAL_PREFIX}*"):
        shutil.rmtree(partial)
    return max((state.parent for state in run_folder.glob(f"{CHECKPOINTS_FOLDER}/*/{STATE_FILE}")), default=None)


def load_progress(checkpoint: Path) -> TrainingProgress:
    """The counts of the training at a checkpoint.

    Raises:
        ValueError: for a damaged file.
    """
    try:
        content = json.loads(
            check_readable_file(checkpoint / STATE_FILE, "checkpoint must be whole", 2**28).read_text(encoding="utf-8")
        )
        return TrainingProgress(**{**content, "curve": [LearningPoint(*point) for point in content["curve"]]})
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise ValueError(f"checkpoint must hold a sound {STATE_FILE}, but {checkpoint} does not: {error!r}") from error


def load_initial_network(policy_folder: Path, model: BaseAlgorithm) -> None:
    """Give a new model the network of a trained policy.

    Raises:
        ValueError: for a folder without a policy, or a policy with another network.
    """
    import torch
    from safetensors.numpy import load_file

    try:
        tensors = {name: torch.from_numpy(t.copy()) for name, t in load_file(policy_folder / WEIGHTS_FILE).items()}
    except OSError as error:
        raise ValueError(
            f"begin must be the folder of a policy, but {policy_folder} has no {WEIGHTS_FILE}; name one"
        ) from error
    for name in ("setting", *_NORMALIZER_TENSORS):
        tensors.pop(name, None)
    shapes, model_shapes = (
        {name: tuple(t.shape) for name, t in state.items()} for state in (tensors, model.policy.state_dict())
    )
    for name in sorted({*shapes, *model_shapes}):
        if shapes.get(name) != model_shapes.get(name):
            raise ValueError(
                f"begin must be a policy with the network of the training, but {policy_folder} has {name} of shape "
                f"{shapes.get(name, 'none')} in place of {model_shapes.get(name, 'none')}; "
                f"train with its hyperparameters"
            )
    model.policy.load_state_dict(tensors)
    _copy_normalizer(policy_folder, model)


def _copy_normalizer(policy_folder: Path, model: BaseAlgorithm) -> None:
    """Give the environments of a model the normaliser of a policy, where both have one."""
    from safetensors.numpy import load_file

    envs = model.get_env()
    tensors = load_file(policy_folder / WEIGHTS_FILE)
    if isinstance(envs, _NormalizedEnvs) and _NORMALIZER_TENSORS[0] in tensors:
        envs.normalizer.mean, envs.normalizer.std = (tensors[name].copy() for name in _NORMALIZER_TENSORS)


def restore_training_state(checkpoint: Path, model: BaseAlgorithm) -> None:
    """Give a new model the weights, moments, buffer, counts and episodes of a checkpoint.

    Raises:
        ValueError: for tensors that are damaged or belong to another model.
    """
    import torch
    from safetensors import SafetensorError
    from safetensors.numpy import load_file

    progress = load_progress(checkpoint)
    model.num_timesteps, model._n_updates = progress.steps, progress.updates
    model._episode_num = progress.episodes
    try:
        _copy_normalizer(checkpoint, model)  # a run that began with a policy has the normaliser of this policy
        tensors = {name: tensor.copy() for name, tensor in load_file(checkpoint / TENSORS_FILE).items()}
        for name in model.get_parameters():
            component = attrgetter(name)(model)
            component_tensors = {
                key: torch.from_numpy(tensor) for key, tensor in tensors_with_prefix(tensors, name).items()
            }
            component.load_state_dict(
                _optimizer_state(component_tensors, component)
                if isinstance(component, torch.optim.Optimizer)
                else component_tensors
            )
        if (entropy := getattr(model, _LOG_ENTROPY_WEIGHT, None)) is not None:
            entropy.data.copy_(torch.from_numpy(tensors[_LOG_ENTROPY_WEIGHT]))
        if (buffer := getattr(model, "replay_buffer", None)) is not None:
            _restore_replay_buffer(buffer, tensors_with_prefix(tensors, "buffer"))
        restore_rollout_state(model, tensors_with_prefix(tensors, "moment"))
    except (KeyError, RuntimeError, ValueError, OSError, SafetensorError) as error:
        raise ValueError(f"checkpoint must hold this algorithm's state, but {checkpoint} does not: {error}") from error


def delete_training_states(run_folder: Path, keep: Path | None = None) -> None:
    """Remove the state of the training from all checkpoints but ``keep``; their policies stay."""
    for state in run_folder.glob(f"{CHECKPOINTS_FOLDER}/*/{STATE_FILE}"):
        if state.parent != keep:
            state.unlink()
            (state.parent / TENSORS_FILE).unlink(missing_ok=True)


def _save_training_state(folder: Path, model: BaseAlgorithm, progress: TrainingProgress) -> None:
    import torch
    from safetensors import SafetensorError
    from safetensors.numpy import save_file

    tensors: TensorDict = {}
    for name, component in model.get_parameters().items():
        if isinstance(attrgetter(name)(model), torch.optim.Optimizer):
            component = {
                f"{i}/{key}": value for i, moments in component["state"].items() for key, value in moments.items()
            }
        tensors |= {f"{name}/{key}": value.detach().cpu().numpy() for key, value in component.items()}
    if (entropy := getattr(model, _LOG_ENTROPY_WEIGHT, None)) is not None:
        tensors[_LOG_ENTROPY_WEIGHT] = entropy.detach().cpu().numpy()
    if (buffer := getattr(model, "replay_buffer", None)) is not None:
        tensors |= {f"buffer/{name}": getattr(buffer, name)[: buffer.size()] for name in _BUFFER_ARRAYS}
        tensors["buffer/position"] = np.array(buffer.pos)
    tensors |= {f"moment/{name}": array for name, array in capture_rollout_state(model).items()}
    try:
        save_file({name: np.array(tensor, order="C") for name, tensor in tensors.items()}, folder / TENSORS_FILE)
    except SafetensorError as error:  # of a full disk
        raise OSError(f"{folder / TENSORS_FILE} cannot be written: {error}; make room, then resume") from error
    write_atomically(folder / STATE_FILE, json.dumps(asdict(progress)))


def _optimizer_state(tensors: dict[str, Any], optimizer: Any) -> dict[str, Any]:
    """The state of an optimiser from its tensors "PARAMETER/MOMENT", with the settings of the model."""
    state: dict[int, dict[str, Any]] = {}
    for key, value in tensors.items():
        index, moment = key.split("/")
        state.setdefault(int(index), {})[moment] = value
    return {"state": state, "param_groups": optimizer.state_dict()["param_groups"]}


def _restore_replay_buffer(buffer: Any, tensors: TensorDict) -> None:
    filled = len(tensors["rewards"])
    for name in _BUFFER_ARRAYS:
        getattr(buffer, name)[:filled] = tensors[name]
    buffer.pos = int(tensors["position"])
    buffer.full = filled == buffer.buffer_size


def capture_rollout_state(model: BaseAlgorithm) -> TensorDict:
    """The state between an update and the next roll-out; empty where the environments cannot be restored."""
    import torch

    envs = model.get_env()
    if not isinstance(envs, _ResumableEnvs):
        return {}
    numpy_state = np.random.get_state(legacy=False)  # noqa: NPY002  Stable-Baselines3 draws from it
    numpy_state["state"]["key"] = numpy_state["state"]["key"].tolist()
    streams = {"numpy": numpy_state, "actions": model.action_space.np_random.bit_generator.state}
    episodes = [[episode[name] for name in _EPISODE_KEYS] for episode in model.ep_info_buffer or ()]
    return {
        "streams": np.frombuffer(json.dumps(streams).encode(), np.uint8),
        "torch": torch.get_rng_state().numpy(),
        "starts": np.asarray(model._last_episode_starts),
        "ended": np.array(episodes, dtype=np.float64).reshape(-1, len(_EPISODE_KEYS)),
        "left": np.array(model._current_progress_remaining),
        **{f"lstm/{index}": value.numpy() for index, value in enumerate(_lstm_states(model))},
        **{f"envs/{name}": array for name, array in envs.episode_state.items()},
    }


def restore_rollout_state(model: BaseAlgorithm, rollout_state: TensorDict) -> None:
    """Put a model with new environments into the state that `capture_rollout_state` returned.

    Raises:
        KeyError, ValueError: for the state of a model with other environments.
    """
    import torch

    if not rollout_state:
        return
    envs = model.get_env()
    assert isinstance(envs, _ResumableEnvs)
    model._last_obs = envs.restore_episode_state(tensors_with_prefix(rollout_state, "envs"))
    model._last_episode_starts = rollout_state["starts"]
    model._current_progress_remaining = float(rollout_state["left"])
    for index, value in enumerate(_lstm_states(model)):
        value.copy_(torch.from_numpy(rollout_state[f"lstm/{index}"]))
    episodes = [dict(zip(_EPISODE_KEYS, row, strict=True)) for row in rollout_state["ended"].tolist()]
    model.ep_info_buffer = deque(episodes, maxlen=model._stats_window_size)
    model.ep_success_buffer = deque(maxlen=model._stats_window_size)
    streams = json.loads(rollout_state["streams"].tobytes())
    np.random.set_state(streams["numpy"])  # noqa: NPY002
    model.action_space.np_random.bit_generator.state = streams["actions"]
    torch.set_rng_state(torch.from_numpy(rollout_state["torch"]))


def tensors_with_prefix(tensors: TensorDict, prefix: str) -> TensorDict:
    """The tensors "PREFIX/KEY", by their keys."""
    return {key.removeprefix(f"{prefix}/"): array for key, array in tensors.items() if key.startswith(f"{prefix}/")}


def _lstm_states(model: Any) -> list[Any]:
    """The LSTM states (layers, n, units) of actor and critic; empty for a model without LSTM."""
    states = getattr(model, "_last_lstm_states", None)
    return [] if states is None else [value for part in states for value in part]
