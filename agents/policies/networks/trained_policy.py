"""Trained policies, played with NumPy: weights in a safetensors file, described by a JSON card. Nothing is unpickled.

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

from agents.policies.networks.compiled_decision import CompiledActor, compile_decision
from agents.policies.networks.feature_encoder import FeatureEncoder
from agents.policies.networks.lstm import FloatArray, Lstm, checked_tensor
from agents.predict_argument_checks import check_observation_finite, check_observation_size
from estimator.models.model import Model
from estimator.models.single_input import check_single_input
from estimator.support.argument_checks import check_integer, check_number, to_float_array
from estimator.support.file_io import check_readable_file

WEIGHTS_FILE = "policy.safetensors"
CARD_FILE = "policy.json"
CARD_FORMAT = 4

#: File beside them in the folder of a training, which says what the run was made from.
CONFIG_FILE = "config.json"

#: No policy learns from more samples.
MAX_STEPS = 10**15

#: No file of a policy is larger [bytes].
_MAX_FILE_BYTES = 2**30


ACTIVATIONS: dict[str, Callable[[FloatArray], FloatArray]] = {
    "tanh": np.tanh,
    "relu": lambda x: np.maximum(x, np.float32(0)),
    "elu": lambda x: np.where(x > 0, x, np.expm1(np.minimum(x, np.float32(0)))),
}


@dataclass(frozen=True)
class NetworkCard:
    """The actor, as the card describes it.

    Attributes:
        layers: names of the linear layers, from the observation (or the memory) to the action.
        activation: between them: tanh, relu or elu.
        squashed: whether the action is the tanh of the last layer, or else its clipped value.
        spread: name of the log standard deviation: a tensor, or a layer beside the last one; None for none.
        memory: name of the LSTM before the layers; None for none.
        levels: evenly spaced actions from -1 to 1, of which the last layer has the log probabilities, up to a constant;
            0 where it has the action itself.
        features: whether the layers take `agents.policies.networks.rollout_features` in place of the observation, and
            the shield bounds the action. The tensor ``setting`` has the references of observations; without it they
            are those of the environment that is played.
        normalised: largest normalised input in standard deviations, with the tensors ``normalizer.mean`` and
            ``normalizer.std``; 0 without normalisation.
    """

    layers: tuple[str, ...]
    activation: str = "tanh"
    squashed: bool = False
    spread: str | None = "log_std"
    memory: str | None = None
    levels: int = 0
    features: bool = False
    normalised: float = 0.0


class TrainedPolicy:
    """A trained actor: a function of the observation, and of its memory where it has one.

    With features it is one compiled function of each observation: features, network, shield.

    Attributes:
        card: see below.
        network: see below.
        layers: weight (out, in) and bias (out,) of each.
        normalizer: mean and standard deviation of their inputs, and the largest normalised input; or None.

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
        self, network: NetworkCard, tensors: Mapping[str, FloatArray], card: dict[str, Any], seed: int = 0
    ) -> None:
        def layer(name: str, inputs: int | None, outputs: int | None = None) -> tuple[FloatArray, FloatArray]:
            weight = checked_tensor(tensors, f"{name}.weight", outputs, inputs)
            return weight, checked_tensor(tensors, f"{name}.bias", len(weight))

        self.card, self.network = card, network
        self._activation = ACTIVATIONS[network.activation]
        self._memory = None if network.memory is None else Lstm(network.memory, tensors)
        width = None if self._memory is None else self._memory.units
        self.layers: list[tuple[FloatArray, FloatArray]] = []
        for name in network.layers[:-1]:
            self.layers.append(layer(name, width))
            width = len(self.layers[-1][0])
        self.layers.append(layer(network.layers[-1], width, network.levels or 1))
        self._level_actions = np.linspace(-1.0, 1.0, network.levels, dtype=np.float32) if network.levels else None
        self._spread: FloatArray | tuple[FloatArray, FloatArray] | None = None
        if network.spread is not None:
            is_tensor = network.spread in tensors
            last = self.layers[-1][0].shape[1]
            self._spread = checked_tensor(tensors, network.spread, 1) if is_tensor else layer(network.spread, last, 1)
        self._n_inputs = (self.layers[0][0] if self._memory is None else self._memory.from_input).shape[1]
        self._description = card.get("features") or {}
        self._encoder: FeatureEncoder | None = None
        if network.features and "setting" in tensors:
            found = FeatureEncoder.from_tensor(tensors["setting"], self._description)
            if found.size != self._n_inputs:
                raise ValueError(f"the first layer must take {found.size} features, but takes {self._n_inputs}")
            self._encoder = found
        self.normalizer: tuple[FloatArray, FloatArray, float] | None = None
        if network.normalised:
            mean, std = (checked_tensor(tensors, f"normalizer.{part}", self._n_inputs) for part in ("mean", "std"))
            check_number("normalised", network.normalised)
            if std.min() <= 0:
                raise ValueError(f"normalizer.std must be positive, but is {std.min()} somewhere; take 1 there")
            self.normalizer = mean, std, float(network.normalised)
        self._actor: CompiledActor | None = None
        if network.features and self._memory is None:
            nothing = np.zeros(self._n_inputs, np.float32), np.ones(self._n_inputs, np.float32), np.inf
            levels, squashed = network.levels, network.squashed
            self._actor = CompiledActor.of(
                self.layers, self.normalizer or nothing, network.activation, levels, squashed
            )
        self._observation_name = "posterior" if network.features else _observation_in_card(card)
        self._rng = np.random.default_rng(seed)

    def adapt_to(self, env: Any) -> None:
        """Play this unwrapped environment, with its prior, limits and noises, in place of the training's.

        Raises:
            ValueError: for an environment with another observation than the card of the policy names, or with several
                inputs. With features:
                for one that `FeatureEncoder.of` refuses, or of another model than the training's, for a policy that
                takes the observation as well.
        """
        experiment = getattr(env, "experiment", None)
        if experiment is not None:
            check_single_input("a trained policy", experiment.model, "choose a signal such as prbs")
        shown = observation_name(env)
        if None not in (self._observation_name, shown) and shown != self._observation_name:
            wanted = "your function" if self._observation_name == "own" else repr(self._observation_name)
            raise ValueError(
                f"env must show the observation {self._observation_name!r}, which the policy learned from, but shows "
                f"{shown!r}; make it with the option observation={wanted}"
            )
        if self.network.features:
            self._encoder = self._check_encoder(
                FeatureEncoder.of(env, with_observation=bool(self._description.get("own")))
            )

    def _check_encoder(self, encoder: FeatureEncoder) -> FeatureEncoder:
        """The encoder, if the network takes its features."""
        model = self._description.get("model")
        if encoder.size != self._n_inputs or (
            encoder.with_observation and model is not None and encoder.model_view.model != Model(**model)
        ):
            raise ValueError(
                f"env must be of the model that the policy was trained on, whose observation it sees, but is of "
                f"{encoder.model_view.model.name!r}; play ppo/universal there, or train a policy on it"
            )
        return encoder

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
        encoder, actor = self._encoder, self._actor
        if self.network.features and encoder is None:
            raise ValueError("env must be given to a policy for all oscillators, but is None; pass it to make_policy")
        if type(observation) is not np.ndarray or observation.dtype.kind != "f":
            observation = to_float_array("observation", observation)
        float_observation = np.asarray(observation, dtype=np.float32)
        size = self._n_inputs if encoder is None else encoder.observation_size
        check_observation_size(float_observation, size)
        if encoder is not None and actor is not None and deterministic:
            rows = np.ascontiguousarray(float_observation.reshape(-1, size))
            actions = np.empty((len(rows), 1), dtype=np.float32)
            if (
                compile_decision(encoder.model_view)(rows, encoder.setting, encoder.with_observation, actor, actions)
                < 0
            ):
                return actions.reshape(*float_observation.shape[:-1], 1), state
        check_observation_finite(float_observation)
        if encoder is None:
            return self._network_output(float_observation, state, episode_start, deterministic)
        features = encoder(float_observation.reshape(-1, size))
        choices, state = self._network_output(features.values, state, episode_start, deterministic)
        return features.to_actions(choices[:, 0]).reshape(*float_observation.shape[:-1], 1), state

    def _network_output(
        self, hidden: FloatArray, state: Any, episode_start: npt.ArrayLike | None, deterministic: bool
    ) -> tuple[FloatArray, Any]:
        """The network's action (n, 1) or (1,) for its inputs, and the next state."""
        if self.normalizer is not None:
            mean, std, max_deviations = self.normalizer
            hidden = np.clip((hidden - mean) / std, -max_deviations, max_deviations)
        if self._memory is not None:
            state = self._memory.update(np.atleast_2d(hidden), state, episode_start)
            hidden = state[0][-1].reshape(*hidden.shape[:-1], -1)
        for weight, bias in self.layers[:-1]:
            hidden = self._activation(hidden @ weight.T + bias)
        weight, bias = self.layers[-1]
        action = hidden @ weight.T + bias
        if self._level_actions is not None:
            if not deterministic:
                action += self._rng.gumbel(size=action.shape).astype(np.float32)  # the largest is then a random one
            return self._level_actions[action.argmax(axis=-1)][..., None], state
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


def observation_name(env: Any) -> str | None:
    """The name of an unwrapped environment's observation; "own" for a function, None for a foreign environment."""
    shown = getattr(getattr(env, "experiment", None), "observation", None)
    return shown if shown is None or isinstance(shown, str) else "own"


def training_steps_of(folder: Path) -> int:
    """Samples that the policy of a folder learned from, by its card.

    Raises:
        ValueError: where there is no sound card.
    """
    try:
        card = json.loads(
            check_readable_file(folder / CARD_FILE, f"policy folder must hold {CARD_FILE}", _MAX_FILE_BYTES).read_text(
                encoding="utf-8"
            )
        )
        steps = card.get("steps", 0)
    except (OSError, ValueError, AttributeError, RecursionError) as error:
        raise ValueError(f"policy folder must hold a sound {CARD_FILE}, but {folder} does not: {error}") from error
    check_integer(f"steps of {folder / CARD_FILE}", steps, MAX_STEPS, 0)
    return int(steps)


def _observation_in_card(card: dict[str, Any]) -> Any:
    """The observation that a card says that its policy learned from, by itself or in the options of its run."""
    config = card.get("config")
    options = config.get("options") if isinstance(config, dict) else None
    return card.get("observation", options.get("observation") if isinstance(options, dict) else None)


def load_policy(folder: str | Path, seed: int = 0) -> TrainedPolicy:
    """Read a policy folder.

    Raises:
        ValueError: if the folder holds no policy, one of a format that this version does not know, or damaged files.
    """
    from safetensors import SafetensorError
    from safetensors.numpy import load_file

    folder = Path(folder)
    if not (folder / WEIGHTS_FILE).is_file() or not (folder / CARD_FILE).is_file():
        raise ValueError(
            f"policy folder must hold {WEIGHTS_FILE} and {CARD_FILE}, but {folder} does not; pass a run folder. "
            "Archives and pickles may run any code when they are opened, so they are not; convert one that you trust "
            f"with agents.save_policy({str(folder).removesuffix('.zip')!r}, PPO.load(...))"
        )
    for name in (WEIGHTS_FILE, CARD_FILE):
        check_readable_file(folder / name, f"policy folder must hold {name}", _MAX_FILE_BYTES)
    try:
        card = json.loads((folder / CARD_FILE).read_text())
        # Copies, because a tensor may lie unaligned in the file, and NumPy then multiplies in another order.
        tensors = {name: tensor.copy() for name, tensor in load_file(folder / WEIGHTS_FILE).items()}
    except (ValueError, RecursionError, SafetensorError) as error:
        raise ValueError(
            f"policy folder must hold sound files, but {folder} does not: {error}; copy it anew"
        ) from error
    found = card.get("format") if isinstance(card, dict) else None
    if found != CARD_FORMAT:
        raise ValueError(
            f"policy card must have format {CARD_FORMAT}, but {folder / CARD_FILE} has {found!r}; train anew"
        )
    try:
        return TrainedPolicy(NetworkCard(**card["network"]), tensors, card, seed)
    except Exception as error:  # a foreign card may raise anything
        raise ValueError(f"policy must be what its card says, but {folder} is not: {error!r}; copy it anew") from error
