"""The moment that a training is in, beside its weights: episodes, streams of random numbers, and the last returns.

With it a training that goes on from a checkpoint is the one that was never stopped, bit for bit.
"""

from __future__ import annotations

import json
from collections import deque
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

if TYPE_CHECKING:
    from stable_baselines3.common.base_class import BaseAlgorithm

Tensors = dict[str, npt.NDArray[Any]]

_ENDED = ("r", "l", "t")


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
    within = {key.removeprefix("envs/"): array for key, array in moment.items() if key.startswith("envs/")}
    model._last_obs = envs.recall(within)
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


def _recurrent(model: Any) -> list[Any]:
    """The memories (layers, n, units) of actor and critic, of a model that has one."""
    states = getattr(model, "_last_lstm_states", None)
    return [] if states is None else [value for part in states for value in part]
