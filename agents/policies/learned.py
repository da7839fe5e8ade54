"""Learned policies: weights in a safetensors file, described by a JSON card. Nothing is ever unpickled.

A policy folder holds ``policy.safetensors`` (the tensors of a Stable-Baselines3 policy, by their names there) and
``policy.json`` (the card: algorithm, network, what it was trained on). Acting needs the actor only, which is evaluated
here with NumPy, so that a trained policy runs without torch.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from agents.asked import check_entries, check_finite, check_state, starts
from agents.policies.decision import Actor, decider
from agents.policies.features import FeatureMap
from estimator.checks import number, numbers, whole
from estimator.files import whole_file
from estimator.models.model import Model

WEIGHTS = "policy.safetensors"
CARD = "policy.json"
FORMAT = 4

#: File beside them in the folder of a training, which says what the run was made from.
CONFIG = "config.json"

#: No policy learns from more samples.
MOST_STEPS = 10**15

#: No file of a policy is larger [bytes].
_LARGEST = 2**30

FloatArray = npt.NDArray[np.float32]
State = tuple[FloatArray, FloatArray]

ACTIVATIONS: dict[str, Callable[[FloatArray], FloatArray]] = {
    "tanh": np.tanh,
    "relu": lambda x: np.maximum(x, np.float32(0)),
    "elu": lambda x: np.where(x > 0, x, np.expm1(np.minimum(x, np.float32(0)))),
}


@dataclass(frozen=True)
class Network:
    """The actor, as the card describes it.

    Attributes:
        layers: names of the linear layers, from the observation (or the memory) to the action.
        activation: between them: tanh, relu or elu.
        squashed: whether the action is the tanh of the last layer, or else its clipped value.
        spread: name of the log standard deviation: a tensor, or a layer beside the last one; None for none.
        memory: name of the LSTM before the layers; None for none.
        levels: evenly spaced actions from -1 to 1, of which the last layer has the log probabilities, up to a constant;
            0 where it has the action itself.
        features: whether the layers see `agents.policies.features` in place of the observation, and the shield bounds
            the action. The tensor ``setting`` is what observations are relative to; without it they are that of the
            environment that is played.
        normalised: what the layers see is normalised, to at most so many standard deviations, with the tensors
            ``normalizer.mean`` and ``normalizer.std``; 0 where it is seen as it is.
    """

    layers: tuple[str, ...]
    activation: str = "tanh"
    squashed: bool = False
    spread: str | None = "log_std"
    memory: str | None = None
    levels: int = 0
    features: bool = False
    normalised: float = 0.0


class LearnedPolicy:
    """A trained actor: a function of the observation, and of its memory where it has one.

    With features it is one compiled function of each observation: features, network, shield.

    Attributes:
        card: see below.
        network: see below.
        layers: weight (out, in) and bias (out,) of each.
        normalizer: mean and standard deviation of what they see, and how many of these they see at most; or None.

    Args:
        network: which tensors make it up, and how.
        tensors: by name; a layer has a weight (out, in) and a bias (out,).
        card: what the policy was trained on, see `save_policy`.
        seed: of the actions that are sampled.

    Raises:
        KeyError: for a tensor that is missing, or an activation that is unknown.
        ValueError: for a tensor that is not finite, or whose shape does not go with the others; for a normaliser that
            divides by what is not positive.
    """

    def __init__(
        self, network: Network, tensors: Mapping[str, FloatArray], card: dict[str, Any], seed: int = 0
    ) -> None:
        def layer(name: str, inputs: int | None, outputs: int | None = None) -> tuple[FloatArray, FloatArray]:
            weight = _tensor(tensors, f"{name}.weight", outputs, inputs)
            return weight, _tensor(tensors, f"{name}.bias", len(weight))

        self.card, self.network = card, network
        self._activation = ACTIVATIONS[network.activation]
        self._memory = None if network.memory is None else _Memory(network.memory, tensors)
        width = None if self._memory is None else self._memory.units
        self.layers: list[tuple[FloatArray, FloatArray]] = []
        for name in network.layers[:-1]:
            self.layers.append(layer(name, width))
            width = len(self.layers[-1][0])
        self.layers.append(layer(network.layers[-1], width, network.levels or 1))
        self._levels = np.linspace(-1.0, 1.0, network.levels, dtype=np.float32) if network.levels else None
        self._spread: FloatArray | tuple[FloatArray, FloatArray] | None = None
        if network.spread is not None:
            is_tensor = network.spread in tensors
            last = self.layers[-1][0].shape[1]
            self._spread = _tensor(tensors, network.spread, 1) if is_tensor else layer(network.spread, last, 1)
        self._seen = (self.layers[0][0] if self._memory is None else self._memory.from_input).shape[1]
        self._description = card.get("features") or {}
        self._map: FeatureMap | None = None
        if network.features and "setting" in tensors:
            found = FeatureMap.from_tensor(tensors["setting"], self._description)
            if found.size != self._seen:
                raise ValueError(f"the first layer must take {found.size} features, but takes {self._seen}")
            self._map = found
        self.normalizer: tuple[FloatArray, FloatArray, float] | None = None
        if network.normalised:
            mean, std = (_tensor(tensors, f"normalizer.{part}", self._seen) for part in ("mean", "std"))
            number("normalised", network.normalised)
            if std.min() <= 0:
                raise ValueError(f"normalizer.std must be positive, but is {std.min()} somewhere; take 1 there")
            self.normalizer = mean, std, float(network.normalised)
        self._actor: Actor | None = None
        if network.features and self._memory is None:
            nothing = np.zeros(self._seen, np.float32), np.ones(self._seen, np.float32), np.inf
            levels, squashed = network.levels, network.squashed
            self._actor = Actor.of(self.layers, self.normalizer or nothing, network.activation, levels, squashed)
        self._shown = "posterior" if network.features else _learned_from(card)
        self._rng = np.random.default_rng(seed)

    def move_to(self, env: Any) -> None:
        """Play this unwrapped environment, with its prior, limits and noises, instead of that of the training.

        Raises:
            ValueError: for an environment that shows another observation than the policy learned from, where its card
                says which. Of a policy with features: for one that `FeatureMap.of` refuses, or that is of another model
                than a policy was trained on that sees the observation itself, too.
        """
        shown = observation_of(env)
        if None not in (self._shown, shown) and shown != self._shown:
            wanted = "your function" if self._shown == "own" else repr(self._shown)
            raise ValueError(
                f"env must show the observation {self._shown!r}, which the policy learned from, but shows {shown!r}; "
                f"make it with the option observation={wanted}"
            )
        if self.network.features:
            self._map = self._fitting(FeatureMap.of(env, own=bool(self._description.get("own"))))

    def _fitting(self, found: FeatureMap) -> FeatureMap:
        """A map that gives what the network takes."""
        model = self._description.get("model")
        if found.size != self._seen or (found.own and model is not None and found.view.model != Model(**model)):
            raise ValueError(
                f"env must be of the model that the policy was trained on, whose observation it sees, but is of "
                f"{found.view.model.name!r}; play ppo/universal there, or train a policy on it"
            )
        return found

    def predict(
        self,
        observation: npt.ArrayLike,
        state: Any = None,
        episode_start: npt.ArrayLike | None = None,
        deterministic: bool = False,
    ) -> tuple[FloatArray, Any]:
        """The action (n, 1) for observations (n, features), or (1,) for one observation.

        The state is Stable-Baselines3's: hidden and cell values, each (1, n, units), of a policy with a memory, which
        forgets them where ``episode_start``; None is a memory of nothing. Without a memory it is handed on unused.

        Raises:
            ValueError: for an observation of another size, or that is not finite; for a policy for all oscillators that
                has no environment.
        """
        found, actor = self._map, self._actor
        if self.network.features and found is None:
            raise ValueError("env must be given to a policy for all oscillators, but is None; pass it to make_policy")
        if type(observation) is not np.ndarray or observation.dtype.kind != "f":
            observation = numbers("observation", observation)
        seen = np.asarray(observation, dtype=np.float32)
        size = self._seen if found is None else found.observation_size
        check_entries(seen, size)
        if found is not None and actor is not None and deterministic:
            rows = np.ascontiguousarray(seen.reshape(-1, size))
            actions = np.empty((len(rows), 1), dtype=np.float32)
            if decider(found.view)(rows, found.setting, found.own, actor, actions) < 0:
                return actions.reshape(*seen.shape[:-1], 1), state
        check_finite(seen)
        if found is None:
            return self._choose(seen, state, episode_start, deterministic)
        features = found(seen.reshape(-1, size))
        choices, state = self._choose(features.values, state, episode_start, deterministic)
        return features.act(choices[:, 0]).reshape(*seen.shape[:-1], 1), state

    def _choose(
        self, hidden: FloatArray, state: Any, episode_start: npt.ArrayLike | None, deterministic: bool
    ) -> tuple[FloatArray, Any]:
        """What the network gives for what it sees, (n, 1) or (1,), and the next state."""
        if self.normalizer is not None:
            mean, std, most = self.normalizer
            hidden = np.clip((hidden - mean) / std, -most, most)
        if self._memory is not None:
            state = self._memory.update(np.atleast_2d(hidden), state, episode_start)
            hidden = state[0][-1].reshape(*hidden.shape[:-1], -1)
        for weight, bias in self.layers[:-1]:
            hidden = self._activation(hidden @ weight.T + bias)
        weight, bias = self.layers[-1]
        action = hidden @ weight.T + bias
        if self._levels is not None:
            if not deterministic:
                action += self._rng.gumbel(size=action.shape).astype(np.float32)  # the largest is then a random one
            return self._levels[action.argmax(axis=-1)][..., None], state
        if not deterministic and self._spread is not None:
            action += np.exp(self._log_std(hidden)) * self._rng.standard_normal(action.shape, dtype=np.float32)
        return np.tanh(action) if self.network.squashed else np.clip(action, -1.0, 1.0), state

    def _log_std(self, hidden: FloatArray) -> FloatArray:
        """Log standard deviation of the action; one that is a layer is kept within Stable-Baselines3's limits."""
        if isinstance(self._spread, tuple):
            weight, bias = self._spread
            return np.clip(hidden @ weight.T + bias, -20.0, 2.0)
        assert self._spread is not None
        return self._spread


def observation_of(env: Any) -> str | None:
    """What an unwrapped environment shows, by its name; "own" for a function, and None for an environment of others."""
    shown = getattr(getattr(env, "experiment", None), "observation", None)
    return shown if shown is None or isinstance(shown, str) else "own"


def steps_of(folder: Path) -> int:
    """Samples that the policy of a folder learned from, by its card.

    Raises:
        ValueError: where there is no sound card.
    """
    try:
        card = json.loads(
            whole_file(folder / CARD, f"policy folder must hold {CARD}", _LARGEST).read_text(encoding="utf-8")
        )
        steps = card.get("steps", 0)
    except (OSError, ValueError, AttributeError, RecursionError) as error:
        raise ValueError(f"policy folder must hold a sound {CARD}, but {folder} does not: {error}") from error
    whole(f"steps of {folder / CARD}", steps, MOST_STEPS, 0)
    return int(steps)


def _learned_from(card: dict[str, Any]) -> Any:
    """The observation that a card says that its policy learned from, by itself or in the options of its run."""
    config = card.get("config")
    options = config.get("options") if isinstance(config, dict) else None
    return card.get("observation", options.get("observation") if isinstance(options, dict) else None)


def _tensor(tensors: Mapping[str, FloatArray], name: str, *shape: int | None) -> FloatArray:
    """A tensor that a network can calculate with; None stands for any length of a side."""
    found = tensors[name]
    sides = zip(found.shape, shape, strict=False)
    fits = found.ndim == len(shape) and all(length > 0 and wish in (None, length) for length, wish in sides)
    must = f"{name} must be finite float32 of shape {tuple('any' if wish is None else wish for wish in shape)}"
    if not fits or found.dtype != np.float32:
        raise ValueError(f"{must}, but is {found.dtype} of {found.shape}")
    if bad := np.count_nonzero(~np.isfinite(found)):
        raise ValueError(f"{must}, but {bad} of its {found.size} numbers are not finite; find what made them so")
    return found


class _Memory:
    """An LSTM of one layer, with torch's tensors: gates in the order input, forget, cell, output."""

    def __init__(self, name: str, tensors: Mapping[str, FloatArray]) -> None:
        self._from_hidden = _tensor(tensors, f"{name}.weight_hh_l0", None, None)
        self.units = self._from_hidden.shape[1]
        gates = 4 * self.units
        _tensor(tensors, f"{name}.weight_hh_l0", gates, self.units)
        self.from_input = _tensor(tensors, f"{name}.weight_ih_l0", gates, None)
        self._bias = _tensor(tensors, f"{name}.bias_ih_l0", gates) + _tensor(tensors, f"{name}.bias_hh_l0", gates)

    def update(self, inputs: FloatArray, state: State | None, episode_start: npt.ArrayLike | None) -> State:
        """Hidden and cell values (1, n, units) after inputs (n, features)."""
        zeros = np.zeros((1, len(inputs), self.units), dtype=np.float32)
        if state is not None:
            check_state(state, 2)
        hidden, cell = (zeros, zeros) if state is None else state
        if hidden.shape != zeros.shape or cell.shape != zeros.shape:
            raise ValueError(f"state must be two arrays of shape {zeros.shape}, but has {hidden.shape}, {cell.shape}")
        if episode_start is not None:
            kept = ~starts(episode_start, len(inputs))[:, None]
            hidden, cell = hidden * kept, cell * kept
        gates = inputs @ self.from_input.T + hidden[0] @ self._from_hidden.T + self._bias
        admit, keep, candidate, show = np.split(gates, 4, axis=-1)
        cell = _sigmoid(keep) * cell[0] + _sigmoid(admit) * np.tanh(candidate)
        hidden = _sigmoid(show) * np.tanh(cell)
        return hidden[None].astype(np.float32), cell[None].astype(np.float32)


def _sigmoid(x: FloatArray) -> FloatArray:
    return np.float32(0.5) * (np.float32(1) + np.tanh(np.float32(0.5) * x))


def load_policy(folder: str | Path, seed: int = 0) -> LearnedPolicy:
    """Read a policy folder.

    Raises:
        ValueError: if the folder holds no policy, one of a format that this version does not know, or damaged files.
    """
    from safetensors import SafetensorError
    from safetensors.numpy import load_file

    folder = Path(folder)
    if not (folder / WEIGHTS).is_file() or not (folder / CARD).is_file():
        raise ValueError(
            f"policy folder must hold {WEIGHTS} and {CARD}, but {folder} does not; pass a run folder. "
            "Archives and pickles may run any code when they are opened, so they are not; convert one that you trust "
            f"with agents.save_policy({str(folder).removesuffix('.zip')!r}, PPO.load(...))"
        )
    for name in (WEIGHTS, CARD):
        whole_file(folder / name, f"policy folder must hold {name}", _LARGEST)
    try:
        card = json.loads((folder / CARD).read_text())
        # Copies, because a tensor may lie unaligned in the file, and NumPy then multiplies in another order.
        tensors = {name: tensor.copy() for name, tensor in load_file(folder / WEIGHTS).items()}
    except (ValueError, RecursionError, SafetensorError) as error:
        raise ValueError(
            f"policy folder must hold sound files, but {folder} does not: {error}; copy it anew"
        ) from error
    found = card.get("format") if isinstance(card, dict) else None
    if found != FORMAT:
        raise ValueError(f"policy card must have format {FORMAT}, but {folder / CARD} has {found!r}; train anew")
    try:
        return LearnedPolicy(Network(**card["network"]), tensors, card, seed)
    except Exception as error:  # whatever a card of somebody else's makes of the readers
        raise ValueError(f"policy must be what its card says, but {folder} is not: {error!r}; copy it anew") from error
