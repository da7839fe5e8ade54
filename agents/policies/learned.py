"""Learned policies: weights in a safetensors file, described by a JSON card. Nothing is ever unpickled.

A policy folder holds ``policy.safetensors`` (the whole state of a Stable-Baselines3 actor-critic, by its names) and
``policy.json`` (the card). Acting needs the actor only: a tanh network, evaluated here with NumPy, so that a trained
policy runs without torch.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from estimator.files import write_atomically

if TYPE_CHECKING:
    from stable_baselines3.common.base_class import BaseAlgorithm

WEIGHTS = "policy.safetensors"
CARD = "policy.json"
FORMAT = 1

FloatArray = npt.NDArray[np.float32]


class LearnedPolicy:
    """A Gaussian policy whose mean is a tanh network of the observation.

    Args:
        layers: weights (out, in) and biases (out,) of each layer; the last one gives the action.
        log_std: (1,) log standard deviation of the action, used where it is not deterministic.
        card: what the policy was trained on, see `save_policy`.
        seed: of the actions that are sampled.
    """

    def __init__(
        self, layers: list[tuple[FloatArray, FloatArray]], log_std: FloatArray, card: dict[str, Any], seed: int = 0
    ) -> None:
        self.layers = layers
        self.log_std = log_std
        self.card = card
        self._rng = np.random.default_rng(seed)

    def predict(
        self,
        observation: npt.ArrayLike,
        state: Any = None,
        episode_start: npt.ArrayLike | None = None,
        deterministic: bool = False,
    ) -> tuple[FloatArray, Any]:
        """The action (n, 1) for observations (n, features), or (1,) for one observation; the state is not used."""
        hidden = np.asarray(observation, dtype=np.float32)
        expected = self.layers[0][0].shape[1]
        if hidden.shape[-1:] != (expected,):
            raise ValueError(f"observation must have {expected} entries, but has shape {hidden.shape}")
        for weight, bias in self.layers[:-1]:
            hidden = np.tanh(hidden @ weight.T + bias)
        weight, bias = self.layers[-1]
        action = hidden @ weight.T + bias
        if not deterministic:
            action += np.exp(self.log_std) * self._rng.standard_normal(action.shape, dtype=np.float32)
        return np.clip(action, -1.0, 1.0), state


def save_policy(folder: Path, model: BaseAlgorithm, card: dict[str, Any]) -> None:
    """Write a trained actor-critic into a folder, each file in one piece.

    Args:
        folder: made where it is missing.
        model: PPO with a tanh network.
        card: what it was trained on: algorithm, track, options, seed, steps, versions.
    """
    from safetensors.numpy import save

    folder.mkdir(parents=True, exist_ok=True)
    tensors = {name: value.detach().cpu().numpy() for name, value in model.policy.state_dict().items()}
    write_atomically(folder / WEIGHTS, save(tensors))
    write_atomically(folder / CARD, json.dumps({"format": FORMAT, **card}, indent=2).encode())


def load_policy(folder: str | Path, seed: int = 0) -> LearnedPolicy:
    """Read a policy folder.

    Raises:
        ValueError: if the folder holds no policy, one of a format that this version does not know, or damaged files.
    """
    from safetensors import SafetensorError
    from safetensors.numpy import load_file

    folder = Path(folder)
    if not (folder / WEIGHTS).is_file() or not (folder / CARD).is_file():
        raise ValueError(f"policy folder must hold {WEIGHTS} and {CARD}, but {folder} does not; pass a run folder")
    try:
        card = json.loads((folder / CARD).read_text())
        # Copies, because a tensor may lie unaligned in the file, and NumPy then multiplies in another order.
        tensors = {name: tensor.copy() for name, tensor in load_file(folder / WEIGHTS).items()}
    except (ValueError, SafetensorError) as error:
        raise ValueError(
            f"policy folder must hold sound files, but {folder} does not: {error}; copy it anew"
        ) from error
    found = card.get("format") if isinstance(card, dict) else None
    if found != FORMAT:
        raise ValueError(f"policy card must have format {FORMAT}, but {folder / CARD} has {found!r}; train anew")
    hidden = sorted(
        (name for name in tensors if name.startswith("mlp_extractor.policy_net.") and name.endswith(".weight")),
        key=lambda name: int(name.split(".")[2]),  # by number: layer 10 comes after layer 2
    )
    names = [name.removesuffix(".weight") for name in hidden] + ["action_net"]
    try:
        layers = [(tensors[f"{name}.weight"], tensors[f"{name}.bias"]) for name in names]
        return LearnedPolicy(layers, tensors["log_std"], card, seed)
    except KeyError as error:
        raise ValueError(f"policy must be an actor-critic of PPO, but {folder / WEIGHTS} lacks {error}") from error
