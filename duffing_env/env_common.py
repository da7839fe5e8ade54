"""The base of single and vector environments: spaces, options, Gymnasium specification, and exclusive calls."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable
from dataclasses import fields
from functools import wraps
from operator import attrgetter
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt
from gymnasium import spaces
from gymnasium.envs.registration import EnvSpec
from gymnasium.vector import AutoresetMode

from duffing_env.batch import Batch
from duffing_env.custom_observation_and_reward import CustomFunctions, experiment_observation_bounds
from duffing_env.experiment_config import Experiment
from estimator.support.argument_checks import did_you_mean, short_repr, to_float_array
from estimator.support.array_types import FloatArray

MethodType = TypeVar("MethodType", bound=Callable[..., Any])


def observation_space(experiment: Experiment) -> spaces.Box:
    """The observation space: a flat float32 Box with finite bounds."""
    low, high = experiment_observation_bounds(experiment).T.astype(np.float32)
    return spaces.Box(low.copy(), high.copy(), dtype=np.float32)


def action_space(experiment: Experiment) -> spaces.Box:
    """The action space: each input in parts of its largest."""
    return spaces.Box(-1.0, 1.0, (experiment.model.n_inputs,), dtype=np.float32)


def action_of_several(action: npt.ArrayLike, n_inputs: int) -> FloatArray:
    """The action of several inputs (inputs,), clipped to [-1, 1].

    Raises:
        ValueError: for an action that is not one finite number for each input.
    """
    try:
        values = to_float_array("action", action)
    except ValueError:
        values = np.array(math.nan)
    if values.shape != (n_inputs,) or not np.isfinite(values).all():
        raise ValueError(
            f"action must be {n_inputs} finite numbers in [-1, 1], one for each input, but is {short_repr(action)}"
        )
    clipped: FloatArray = np.clip(values, -1.0, 1.0)
    return clipped


def scalar_action(action: npt.ArrayLike) -> float:
    """The action of an only input as one number, clipped to [-1, 1].

    Raises:
        ValueError: for an action that is not one finite number.
    """
    try:
        given = action if type(action) is np.ndarray else to_float_array("action", action)
        item = given.item() if given.size == 1 else math.nan
        value = math.nan if isinstance(item, str | bytes) else float(item)  # float() reads text, too
    except (TypeError, ValueError, OverflowError):
        value = math.nan
    if not math.isfinite(value):
        remedy = "; pass action.detach()" if getattr(action, "requires_grad", False) else ""
        raise ValueError(f"action must be one finite number in [-1, 1], but is {short_repr(action)}{remedy}")
    return min(max(value, -1.0), 1.0)


def check_reset_options(options: dict[str, Any] | None, *allowed: str) -> dict[str, Any]:
    """The options of a reset as a dict.

    Raises:
        ValueError: for options that are no dict, or an unknown one.
    """
    if not isinstance(options, dict | None):
        raise ValueError(f"options of reset must be a dict or None, but are {options!r:.200}")
    for name in options or {}:
        if name not in allowed:
            raise ValueError(f"options of reset must be among {list(allowed)}, but there is {name!r}; remove it")
    return options or {}


class _DefaultEpisodeSteps(int):
    """Steps of an episode by the environment's horizon, in contrast to a limit from the user."""


class TrackSpec(EnvSpec):
    """A specification with the number of steps of an episode, which wrappers read.

    The number follows from the options, and an environment made from the specification may get other options. So it is
    no limit: `gymnasium.make` and `make_vec`, which would truncate a longer ``horizon`` by it, read None, as does JSON.
    A limit from the user (``max_episode_steps=9``) stays a limit.
    """

    @property
    def max_episode_steps(self) -> int | None:
        """Steps of an episode at most."""
        steps: int | None = self.__dict__["max_episode_steps"]
        calling_frame = sys._getframe(1)
        is_gym_make = calling_frame.f_globals.get(
            "__name__"
        ) == EnvSpec.__module__ and calling_frame.f_code.co_name in ("make", "make_vec")
        return None if is_gym_make and isinstance(steps, _DefaultEpisodeSteps) else steps

    @max_episode_steps.setter
    def max_episode_steps(self, steps: int | None) -> None:
        self.__dict__["max_episode_steps"] = steps

    def to_json(self) -> str:
        """JSON that `gymnasium.envs.registration.EnvSpec.from_json` reads again."""
        spec_fields = {field.name: getattr(self, field.name) for field in fields(EnvSpec) if field.init}
        if isinstance(spec_fields["max_episode_steps"], _DefaultEpisodeSteps):
            spec_fields["max_episode_steps"] = None
        return EnvSpec(**spec_fields).to_json()


class ReadOnlyOption:
    """A read-only attribute of an environment: setting an option of a made environment would have no effect.

    Args:
        name: name of the attribute and of the argument.
        attribute_path: path to the value from the environment, with dots.
    """

    def __init__(self, name: str, attribute_path: str) -> None:
        self._name, self._read = name, attrgetter(attribute_path)

    def __get__(self, env: Any, owner: type | None = None) -> Any:
        if env is None:
            return self
        return env.__dict__[self._name] if self._name in env.__dict__ else self._read(env)

    def __set__(self, env: Any, value: Any) -> None:
        if not hasattr(env, self._name):  # an option of other environments only
            env.__dict__[self._name] = value
            return
        raise AttributeError(
            f"{self._name} cannot be set to {short_repr(value)} in an environment that is made already; make a new one "
            f"with {self._name}=..., or choose the system of an episode with reset(options={{'truth': ...}})"
        )


class ExperimentEnv:
    """Base of single and vector environments: options, beliefs and specification.

    The options are read-only attributes. Setting one, by `setattr`, ``set_wrapper_attr`` or ``set_attr``, raises an
    AttributeError: an experiment keeps the options that it was made with.

    The specification gives Gymnasium's wrappers the number of steps of an episode (`TrackSpec`). The registration does
    not contain it, because Gymnasium would then truncate a longer ``horizon``.
    """

    experiment: Experiment
    _batch: Batch
    _custom: CustomFunctions | None
    _spec: EnvSpec | None = None

    def __init_subclass__(cls, **named: Any) -> None:
        super().__init_subclass__(**named)
        for name in (field.name for field in fields(cls._experiment_class())):
            if not hasattr(cls, name):
                setattr(cls, name, ReadOnlyOption(name, f"experiment.{name}"))

    @classmethod
    def _experiment_class(cls) -> type[Experiment]:
        """The class of experiments whose fields are the environment's options."""
        raise NotImplementedError

    @property
    def records(self) -> FloatArray:
        """(environments, size) the posteriors now, as the flat records of `estimator.Belief`; a copy."""
        return self._batch.records()

    def mixture(self, index: int = 0) -> tuple[FloatArray, FloatArray]:
        """Records (m, size) and weights (m,) of environment ``index``: one belief, or one for each noise hypothesis."""
        return self._batch.mixture(index)

    @property
    def _observation_owner(self) -> Batch | CustomFunctions:
        """The object that holds the observations."""
        return self._batch if self._custom is None else self._custom

    @property
    def last_observations(self) -> npt.NDArray[np.float32]:
        """(environments, entries) the observations of the last reset or step; not a copy."""
        return self._observation_owner.observations

    #: Input of the action 1, or by the names of several inputs.
    max_input: Any = ReadOnlyOption("max_input", "experiment.max_input")

    #: Samples of an episode without an early end.
    horizon: Any = ReadOnlyOption("horizon", "experiment.samples")

    @property
    def spec(self) -> EnvSpec | None:
        """The specification that the environment was made from."""
        return self._spec

    @spec.setter
    def spec(self, spec: EnvSpec | None) -> None:
        if spec is not None:
            spec_fields = {field.name: getattr(spec, field.name) for field in fields(EnvSpec) if field.init}
            # Values that JSON can hold.
            modes = {name: mode.value for name, mode in spec.kwargs.items() if isinstance(mode, AutoresetMode)}
            spec_fields["kwargs"] = {**spec.kwargs, **modes}
            if spec_fields["max_episode_steps"] is None or isinstance(
                spec_fields["max_episode_steps"], _DefaultEpisodeSteps
            ):
                steps, limit = -(-self.experiment.samples // self.experiment.hold), spec.kwargs.get("max_episode_steps")
                # A vector environment has the user's limit among its options.
                spec_fields["max_episode_steps"] = _DefaultEpisodeSteps(
                    min(steps, limit) if limit and limit > 0 else steps
                )
            spec = TrackSpec(**spec_fields)
        self._spec = spec


class UnknownOption(TypeError, ValueError):
    """An unknown option, in the words of Python's TypeError, which some trainers catch."""


def make_experiment(experiment_class: type[Experiment], options: dict[str, Any]) -> Experiment:
    """An experiment from keyword arguments.

    Raises:
        UnknownOption: for an unknown option, with the nearest known one.
    """
    option_names = [field.name for field in fields(experiment_class)]
    for name in options:
        if name not in option_names:
            raise UnknownOption(
                f"got an unexpected keyword argument {name!r}: the options of this environment are {option_names}"
                f"{did_you_mean(name, option_names)}"
            )
    return experiment_class(**options)


def refuse_concurrent_calls(method: MethodType) -> MethodType:
    """Refuse a call of the method before the last call of such a method has returned; nothing has changed then.

    Two threads that step at once would mix two steps into one. The object has a list ``_call_token`` of one entry: a
    call takes it out and puts it back, a lock that can be copied.

    Raises:
        RuntimeError: for the second call.
    """

    @wraps(method)
    def exclusive_call(self: Any, *args: Any, **kwargs: Any) -> Any:
        try:
            token = self._call_token.pop()
        except IndexError:
            raise RuntimeError(
                f"{method.__name__} must wait until the last call of this environment has returned, but another thread "
                "called it meanwhile; give each thread an environment of its own"
            ) from None
        try:
            return method(self, *args, **kwargs)
        finally:
            self._call_token.append(token)

    return exclusive_call  # type: ignore[return-value]
