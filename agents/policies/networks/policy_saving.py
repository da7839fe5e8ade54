"""Trained policies written: into a folder that `agents.policies.networks.trained_policy` reads."""

from __future__ import annotations

import json
import os
import shutil
import tempfile
from collections.abc import Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from agents.output_paths import check_output_folder
from agents.policies.custom_policies import check_wrappers, wrapped_environments
from agents.policies.networks.feature_names import MAX_FEATURE
from agents.policies.networks.trained_policy import (
    ACTIVATIONS,
    CARD_FILE,
    CARD_FORMAT,
    CONFIG_FILE,
    MAX_STEPS,
    WEIGHTS_FILE,
    NetworkCard,
    TrainedPolicy,
    observation_name,
)
from estimator.support.argument_checks import check_integer, check_mapping, check_number, short_repr, to_float_array
from estimator.support.file_io import explain_write_errors, to_path, write_atomically

if TYPE_CHECKING:
    from stable_baselines3.common.base_class import BaseAlgorithm
    from torch.nn import Module

#: Mean and standard deviation of observations, and how many standard deviations are seen at most.
ObservationNormalizer = tuple[npt.ArrayLike, npt.ArrayLike, float]


def save_policy(
    folder: str | Path,
    model: BaseAlgorithm | Module,
    card: dict[str, Any] | None = None,
    normalizer: ObservationNormalizer | None = None,
) -> None:
    """Write a trained policy into a folder, all of it or nothing; `make_policy` plays it, without torch.

    The observations' normaliser goes with it, where the model's environment is a `VecNormalize`. An archive of
    Stable-Baselines3 holds pickles, which can run any code when they are opened. So it is never opened here. Whoever
    trusts one converts it: ``save_policy("runs/mine", PPO.load("model.zip", env))``, where ``env`` is
    ``VecNormalize.load("vecnormalize.pkl", env)`` if it was trained with one.

    Args:
        folder: made where it is missing. A policy that is there is replaced; a training run is not.
        model: PPO, A2C, SAC, TD3 or DDPG of Stable-Baselines3, TQC or RecurrentPPO of sb3-contrib, with a network of
            linear layers. Of those that learn from a buffer only the actor is written; the others are written whole.
            Or, of whatever was trained elsewhere, the ``torch.nn.Sequential`` that gives the mean of the action: linear
            layers with tanh, ReLU or ELU between them, and perhaps a tanh at the end.
        card: what it was trained on: algorithm, track, options, seed, steps, versions; its algorithm and steps where
            it is None. Its steps are all samples that it ever learned from, which the algorithm counts anew in every
            ``learn`` but with ``reset_num_timesteps=False``. JSON must be able to hold it. Its ``observation``
            ("posterior", "history", "privileged", or "own") is that of the model's environment where it has none; an
            environment that shows another is refused.
        normalizer: mean and standard deviation (features,) of the observations, and how many standard deviations a
            network of torch sees at most, all positive but the mean; None where it sees them as they are.

    Raises:
        ValueError: for a folder that `check_policy_folder` refuses, or a model that `TrainedPolicy` could not play as
            it is, or a card that JSON cannot hold; nothing is written then.
        NotADirectoryError: where the folder is a file.
    """
    write_policy(check_policy_folder("folder", folder), model, card, normalizer)


def check_policy_folder(name: str, folder: str | Path) -> Path:
    """The folder for a policy, before the work begins.

    Args:
        name: of the argument.
        folder: that it names.

    Raises:
        ValueError: for what is no path, or the folder of a training run, whose policy is that of its log.
        NotADirectoryError: where it is a file.
    """
    place = to_path(name, folder)
    check_output_folder(name, place)
    if (place / CONFIG_FILE).exists():
        raise ValueError(f"{name} must be a folder for a policy, but {place} holds a run; remove it or name another")
    return place


def write_policy(
    folder: Path,
    model: BaseAlgorithm | Module,
    card: dict[str, Any] | None = None,
    normalizer: ObservationNormalizer | None = None,
) -> None:
    """As `save_policy`, and also into the folder of a run, by the training itself."""
    from torch.nn import Module

    check_mapping("card", {} if card is None else card)
    if isinstance(model, Module):
        _write_files(folder, *_card_of_module(model, normalizer), card or {})
        return
    if normalizer is not None:
        raise ValueError("normalizer must be None for an algorithm, whose VecNormalize is written; leave it out")
    if not hasattr(model, "policy"):
        raise ValueError(f"model must be an algorithm or a module of torch, but is {short_repr(model)}; pass one")
    card = {"algorithm": type(model).__name__.lower(), "steps": model.num_timesteps} if card is None else card
    check_wrappers(model)
    environments = wrapped_environments(model)
    if environments and (observation := observation_name(environments[-1])) is not None:
        card = {"observation": observation} | card
    tensors = {name: value.detach().cpu().numpy() for name, value in model.policy.state_dict().items()}
    if not hasattr(model.policy, "mlp_extractor"):
        tensors = {name: tensor for name, tensor in tensors.items() if name.startswith("actor.")}
    network = _card_of_algorithm(model.policy, tensors)
    if network.levels and not _has_discrete_inputs(model):
        raise ValueError(
            f"model must choose an input, or one of the levels of DuffingVecEnv, but its actions are {network.levels} "
            f"numbers of another environment; train and save it with DuffingVecEnv(..., levels={network.levels})"
        )
    vec_normalize = _vec_normalize_of(model)
    if vec_normalize is not None:
        network = replace(network, normalised=float(vec_normalize.clip_obs))
        tensors["normalizer.mean"] = vec_normalize.obs_rms.mean.astype(np.float32)
        tensors["normalizer.std"] = np.sqrt(vec_normalize.obs_rms.var + vec_normalize.epsilon).astype(np.float32)
    envs: Any = model.get_env()
    if hasattr(envs, "features"):
        network = replace(network, features=True, normalised=MAX_FEATURE)
        tensors |= envs.tensors
        card = card | {"features": envs.features}
    _write_files(folder, network, tensors, card)


def _write_files(folder: Path, network: NetworkCard, tensors: dict[str, Any], card: dict[str, Any]) -> None:
    """Write both files, or nothing: what is there is gone only when all of the new is."""
    from safetensors.numpy import save

    _check_card(card)
    try:
        TrainedPolicy(network, tensors, card)
    except KeyError as error:
        raise ValueError(f"model must have a bias in every layer, but {error} is missing; give it one") from error
    folder.mkdir(parents=True, exist_ok=True)
    with explain_write_errors(folder):
        half_written = Path(tempfile.mkdtemp(dir=folder, prefix=f".{WEIGHTS_FILE}."))
    try:
        write_atomically(half_written / WEIGHTS_FILE, save(tensors))
        written_here = {
            "format": CARD_FORMAT,
            "network": asdict(network),
        }  # also where the card belongs to another policy
        write_atomically(half_written / CARD_FILE, json.dumps({**written_here, **card, **written_here}, indent=2))
        # Weights without a card are no policy, so none is ever read with the card of another.
        (folder / CARD_FILE).unlink(missing_ok=True)
        for name in (WEIGHTS_FILE, CARD_FILE):
            os.replace(half_written / name, folder / name)
    finally:
        shutil.rmtree(half_written, ignore_errors=True)


def _check_card(card: dict[str, Any]) -> None:
    """Refuse a card that JSON cannot hold, or whose steps are no number of samples, which the protocol reads."""
    check_integer("card['steps']", card.get("steps", 0), MAX_STEPS, 0)
    for key, value in card.items():
        try:
            json.dumps(value)
        except (TypeError, ValueError, RecursionError) as error:
            raise ValueError(
                f"card[{key!r}] must be what JSON can hold, but is {short_repr(value)}: {error}; "
                "pass e.g. float(...) or str(...)"
            ) from error


def _card_of_module(model: Module, normalizer: ObservationNormalizer | None) -> tuple[NetworkCard, dict[str, Any]]:
    """A network that is not an algorithm's, and its tensors; ValueError for what has no place in a `Network`."""
    from torch.nn import Sequential

    model = model if isinstance(model, Sequential) else Sequential(model)
    layer_types = [type(part).__name__.lower() if getattr(part, "alpha", 1.0) == 1.0 else repr(part) for part in model]
    squashed = layer_types[-1:] == ["tanh"]
    layers = layer_types[: len(layer_types) - squashed]
    between = set(layers[1::2])
    if len(layers) % 2 == 0 or set(layers[::2]) != {"linear"} or len(between) > 1 or not between <= set(ACTIVATIONS):
        raise ValueError(
            f"model must be linear layers with one of {', '.join(ACTIVATIONS)} between them, but is {layer_types}; "
            "pass it to make_policy as it is"
        )
    names = tuple(str(place) for place in range(0, len(layers), 2))
    tensors = {name: value.detach().cpu().numpy() for name, value in model.state_dict().items()}
    network = NetworkCard(names, next(iter(between), "tanh"), squashed=squashed, spread=None)
    if normalizer is not None:
        if not isinstance(normalizer, tuple | list) or len(normalizer) != 3:
            raise ValueError(
                "normalizer must be mean, standard deviation, and how many of these are seen at most, but is "
                f"{short_repr(normalizer)}; pass all three"
            )
        mean, std = (to_float_array(f"normalizer[{k}]", normalizer[k]).astype(np.float32) for k in (0, 1))
        check_number("normalizer[2]", normalizer[2], remedy="pass e.g. 10.0")
        network = replace(network, normalised=float(normalizer[2]))
        tensors |= {"normalizer.mean": mean, "normalizer.std": std}
    return network, tensors


def _vec_normalize_of(model: BaseAlgorithm) -> Any:
    """The `VecNormalize` that the model sees its environment through; None for none that normalises observations.

    Raises:
        ValueError: for another wrapper that changes observations, which is not written.
    """
    from stable_baselines3.common.vec_env import VecCheckNan, VecEnvWrapper, VecMonitor, VecNormalize

    found, envs = None, model.get_env()
    while isinstance(envs, VecEnvWrapper) and not hasattr(envs, "features"):
        if isinstance(envs, VecNormalize):
            found = envs if envs.norm_obs else found
        elif not isinstance(envs, VecMonitor | VecCheckNan):
            raise ValueError(
                f"model must see its environment as it is or through VecNormalize, but sees it through "
                f"{type(envs).__name__}; leave that out, or pass a policy of your own to make_policy"
            )
        envs = envs.venv
    return found


def _has_discrete_inputs(model: BaseAlgorithm) -> bool:
    """Whether numbers as actions are evenly spaced inputs, as in our environments."""
    from agents.sb3_vec_env import BatchVecEnv

    envs: Any = model.get_env()
    while hasattr(envs, "venv"):
        envs = envs.venv
    return isinstance(envs, BatchVecEnv)


def _card_of_algorithm(policy: Any, tensors: Mapping[str, Any]) -> NetworkCard:
    """What the actor of a Stable-Baselines3 policy is made of; ValueError where `TrainedPolicy` could not play it."""

    def layers(within: str) -> tuple[str, ...]:
        return tuple(n.removesuffix(".weight") for n in tensors if n.startswith(f"{within}.") and n.endswith(".weight"))

    activation = getattr(getattr(policy, "activation_fn", None), "__name__", "none").lower()
    actor = getattr(policy, "actor", policy)
    faults = {
        f"the activation {activation}": activation not in ACTIVATIONS,
        "a network for features": any("features_extractor." in name for name in tensors),
        "exploration that depends on the state (use_sde)": getattr(actor, "use_sde", False),
        "an LSTM of several layers": any(name.endswith("weight_ih_l1") for name in tensors),
        "no actor": not (hasattr(policy, "mlp_extractor") or layers("actor.mu") or "actor.mu.weight" in tensors),
        "normalised layers": any(name.endswith("running_mean") for name in tensors),
    }
    if any(faults.values()):
        raise ValueError(
            f"model must have linear layers with {', '.join(ACTIVATIONS)} between them, but has "
            f"{next(fault for fault, found in faults.items() if found)}; pass a policy of your own to make_policy"
        )
    if hasattr(policy, "mlp_extractor"):  # PPO and RecurrentPPO
        memory = "lstm_actor" if hasattr(policy, "lstm_actor") else None
        levels = int(getattr(policy.action_space, "n", 0))
        spread = None if levels else "log_std"
        names = (*layers("mlp_extractor.policy_net"), "action_net")
        return NetworkCard(names, activation, spread=spread, memory=memory, levels=levels)
    if "actor.log_std.weight" in tensors:  # SAC and TQC
        return NetworkCard((*layers("actor.latent_pi"), "actor.mu"), activation, squashed=True, spread="actor.log_std")
    return NetworkCard(layers("actor.mu"), activation, squashed=True, spread=None)  # TD3
