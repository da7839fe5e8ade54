"""Policies of a user's own: objects with ``predict``, classes that make one, and functions of the observation."""

from __future__ import annotations

import inspect
import sys
from typing import Any

import numpy as np
import numpy.typing as npt
from gymnasium import ActionWrapper, ObservationWrapper, Wrapper
from gymnasium.vector import VectorActionWrapper, VectorObservationWrapper, VectorWrapper

from estimator.support.argument_checks import short_repr, to_float_array

#: Gymnasium's wrappers that change observations or actions.
_TRANSFORMING_WRAPPERS = (ObservationWrapper, ActionWrapper, VectorObservationWrapper, VectorActionWrapper)


def custom_policy(policy: Any, env: Any, seed: int, options: dict[str, Any]) -> Any:
    """The policy that a user's own thing is, or makes; see `agents.policies.make_policy`.

    Raises:
        ValueError: for options that it does not take, a thing that is not a policy, or a model that `check_wrappers`
            refuses.
    """
    if isinstance(policy, type):
        parameters = inspect.signature(policy).parameters
        known = {"env": env, "seed": seed} | options
        for option, value in options.items():
            if option not in parameters:
                raise ValueError(f"{option}={value!r} is no option of {policy.__name__}, which has {list(parameters)}")
        policy = policy(**{name: known[name] for name in parameters if name in known})
    elif options:
        raise ValueError(f"options must be none for a policy that is made, but are {options}; leave them out")
    if hasattr(policy, "predict"):
        check_wrappers(policy)
        vec_normalize = policy.get_vec_normalize_env() if hasattr(policy, "get_vec_normalize_env") else None
        if vec_normalize is None:
            return policy
        if getattr(env, "norm_obs", False):
            raise ValueError(
                "env must show its observations as they are, which the model's own VecNormalize normalises, but is a "
                "VecNormalize, too; pass the environment within, env.venv"
            )
        return _NormalisedModel(policy, vec_normalize)
    if not callable(policy):
        raise ValueError(f"policy must have predict, or be a function of observations, but is {policy!r:.60}")
    return _FunctionPolicy(policy, env)


def unwrap_vec_env(env: Any, is_signal: bool) -> Any:
    """An environment of Gymnasium (or None) as it is, or that within a `VecEnv` of Stable-Baselines3.

    Args:
        env: as `agents.policies.make_policy` takes it.
        is_signal: whether the policy looks at no observation.

    Raises:
        ValueError: for what is no environment, or a `VecEnv` that shows or takes something else than its environment.
    """
    if env is not None and not hasattr(env, "unwrapped"):
        raise ValueError(
            f"env must be an environment, but is {short_repr(env)}; pass what gym.make or gym.make_vec returns"
        )
    if not hasattr(env, "env_is_wrapped"):  # which a VecEnv has
        return env
    wrapper = env
    while hasattr(wrapper, "venv"):
        if not is_signal and changes_observations(wrapper):
            raise ValueError(
                f"env must show its observations as they are, but {type(wrapper).__name__} changes them, which this "
                "policy was not made for; play the environment without it, or choose a signal such as prbs"
            )
        wrapper = wrapper.venv
    inner = getattr(wrapper, "envs", None)
    inner = inner[0] if isinstance(inner, list) else inner
    if inner is None:
        raise ValueError(
            f"env must have its environments in this process, but {type(wrapper).__name__} has not; "
            "make it as agents.sb3_vec_env.DuffingVecEnv(id, n)"
        )
    if hasattr(env, "features") or env.action_space != getattr(inner, "single_action_space", inner.action_space):
        raise ValueError(
            f"env must take inputs as actions, but {type(env).__name__} takes something else, {env.action_space}; make "
            "it without levels or features"
        )
    return inner


def changes_observations(wrapper: Any) -> bool:
    """Whether a wrapper of Stable-Baselines3 around a `VecEnv` shows something else than that."""
    # A wrapper also has the attributes of what it wraps.
    return bool(vars(wrapper).get("norm_obs", wrapper.observation_space != wrapper.venv.observation_space))


def wrapped_environments(model: Any) -> list[Any]:
    """A model's environment, as Gymnasium's wrappers have it, from the outermost to the environment itself.

    Of several that are alike the first; nothing where the model of Stable-Baselines3 holds none here.
    """
    vec_env: Any = model.get_env() if hasattr(model, "get_env") else None
    while hasattr(vec_env, "venv"):
        vec_env = vec_env.venv
    layer = getattr(vec_env, "envs", None)
    layer = layer[0] if isinstance(layer, list) else layer
    found = []
    while layer is not None:
        found.append(layer)
        layer = layer.env if isinstance(layer, Wrapper | VectorWrapper) else None
    return found


def check_wrappers(model: Any) -> None:
    """Refuse a model of Stable-Baselines3 whose environment is wrapped in what changes observations or actions.

    Those wrappers are not played: a policy is asked for actions of the environment itself.

    Raises:
        ValueError: naming the wrapper.
    """
    for wrapper in wrapped_environments(model)[:-1]:
        # A wrapper has spaces of its own where it changes them, whatever its kind.
        spaces = (getattr(wrapper, f"_{space}_space", None) for space in ("observation", "action"))
        if isinstance(wrapper, _TRANSFORMING_WRAPPERS) or any(space is not None for space in spaces):
            raise ValueError(
                f"model must see its environment as it is or through VecNormalize, but it is wrapped in "
                f"{type(wrapper).__name__}; train without it, with VecNormalize, which is kept, or save the network of "
                "torch with the normalizer that it saw"
            )


class _NormalisedModel:
    """A model of Stable-Baselines3 that was trained through `VecNormalize`."""

    def __init__(self, model: Any, normalizer: Any) -> None:
        self._model, self._normalizer = model, normalizer

    def predict(self, observation: npt.ArrayLike, *how: Any, **named: Any) -> Any:
        """As the model's, of the observation itself."""
        return self._model.predict(
            self._normalizer.normalize_obs(to_float_array("observation", observation)), *how, **named
        )


class _FunctionPolicy:
    """A function of observations (n, features) that gives actions (n, inputs): NumPy's, or a module of torch.

    For one input it may give (n,). The number of inputs is the environment's, or 1 without one.
    """

    def __init__(self, function: Any, env: Any) -> None:
        self._function = function
        space = getattr(env, "single_action_space", getattr(env, "action_space", None))
        self._n_inputs = 1 if getattr(space, "shape", None) in (None, ()) else space.shape[-1]  # type: ignore[union-attr]
        torch = sys.modules.get("torch")
        self._is_module = torch is not None and isinstance(function, torch.nn.Module)

    def predict(
        self, observation: npt.ArrayLike, state: Any = None, episode_start: Any = None, deterministic: bool = False
    ) -> tuple[npt.NDArray[np.float32], Any]:
        """As `agents.policies.Policy`; actions beyond the limits are cut."""
        seen = to_float_array("observation", observation).astype(np.float32)
        rows = np.atleast_2d(seen)
        if not self._is_module:
            chosen = self._function(rows)
        else:
            import torch

            weight = next(self._function.parameters(), torch.zeros(()))
            with torch.no_grad():
                try:
                    chosen = self._function(torch.as_tensor(rows, dtype=weight.dtype, device=weight.device))
                except RuntimeError as error:
                    raise ValueError(f"it must take observations of shape {rows.shape}, but says: {error}") from error
        if hasattr(chosen, "detach"):
            chosen = chosen.detach().cpu().numpy()
        actions = np.asarray(chosen, dtype=np.float32)
        if actions.size != len(rows) * self._n_inputs or not np.isfinite(actions).all():
            each = "a finite action" if self._n_inputs == 1 else f"{self._n_inputs} finite inputs"
            raise ValueError(f"policy must give {each} for each of {len(rows)} observations, but gave {actions!r:.200}")
        return np.clip(actions, -1.0, 1.0).reshape(*seen.shape[:-1], self._n_inputs), state
