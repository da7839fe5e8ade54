"""What single and vector environments share: spaces, options, specification, and that one call goes at a time."""

from __future__ import annotations

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
from duffing_env.custom_functions import CustomFunctions, experiment_observation_bounds
from duffing_env.experiment_config import Experiment
from estimator.support.argument_checks import did_you_mean, short_repr
from estimator.support.array_types import FloatArray

MethodType = TypeVar("MethodType", bound=Callable[..., Any])


def observation_space(experiment: Experiment) -> spaces.Box:
    """The observation's space: a flat float32 Box with finite bounds."""
    low, high = experiment_observation_bounds(experiment).T.astype(np.float32)
    return spaces.Box(low.copy(), high.copy(), dtype=np.float32)


def action_space() -> spaces.Box:
    """The action's space: the input in parts of the largest."""
    return spaces.Box(-1.0, 1.0, (1,), dtype=np.float32)


def check_reset_options(options: dict[str, Any] | None, *allowed: str) -> dict[str, Any]:
    """The options of a reset; ValueError for one that is not known, or what is not a dict."""
    if not isinstance(options, dict | None):
        raise ValueError(f"options of reset must be a dict or None, but are {options!r:.200}")
    for name in options or {}:
        if name not in allowed:
            raise ValueError(f"options of reset must be among {list(allowed)}, but there is {name!r}; remove it")
    return options or {}


class _DefaultEpisodeSteps(int):
    """Steps of an episode by the environment's own horizon, and not by a limit that somebody asked for."""


class TrackSpec(EnvSpec):
    """A specification that says after how many steps an episode ends, which wrappers ask for.

    That number follows from the options, and an environment made from the specification may be given others. So it is
    no limit: `gymnasium.make` and `make_vec`, which would cut a longer ``horizon`` short by it, find None, and JSON has
    None. A limit that was asked for (``max_episode_steps=9``) stays one.
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
        """As `gymnasium.envs.registration.EnvSpec`, which reads it again."""
        spec_fields = {field.name: getattr(self, field.name) for field in fields(EnvSpec) if field.init}
        if isinstance(spec_fields["max_episode_steps"], _DefaultEpisodeSteps):
            spec_fields["max_episode_steps"] = None
        return EnvSpec(**spec_fields).to_json()


class ReadOnlyOption:
    """An attribute of an environment that can be read, but not set, because nothing would follow from it.

    Args:
        name: of the attribute, and of the argument that it was made with.
        attribute_path: where it is read, from the environment on.
    """

    def __init__(self, name: str, attribute_path: str) -> None:
        self._name, self._read = name, attrgetter(attribute_path)

    def __get__(self, env: Any, owner: type | None = None) -> Any:
        if env is None:
            return self
        return env.__dict__[self._name] if self._name in env.__dict__ else self._read(env)

    def __set__(self, env: Any, value: Any) -> None:
        if not hasattr(env, self._name):  # an option of other environments, which this one has not
            env.__dict__[self._name] = value
            return
        raise AttributeError(
            f"{self._name} cannot be set to {short_repr(value)} in an environment that is made already; make a new one with "
            f"{self._name}=..., or choose the system of an episode with reset(options={{'truth': ...}})"
        )


class ExperimentEnv:
    """What an environment, single or vector, tells of its experiment and beliefs, and its specification.

    Its options are attributes that can be read. Whoever sets one, by `setattr`, ``set_wrapper_attr`` or ``set_attr``,
    gets an AttributeError: an experiment is what it was made as.

    The specification tells Gymnasium's wrappers after how many steps an episode ends (`TrackSpec`). That is no part of
    what is registered, because Gymnasium would then cut a longer ``horizon`` short.
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
        """The experiments whose options are those of the environment."""
        raise NotImplementedError

    @property
    def records(self) -> FloatArray:
        """(environments, size) the posteriors now, as the flat records of `estimator.Belief`; a copy."""
        return self._batch.records()

    def mixture(self, index: int = 0) -> tuple[FloatArray, FloatArray]:
        """Records (m, size) and weights (m,) of the beliefs that one weighs: one, or one for each hypothesis."""
        return self._batch.mixture(index)

    @property
    def _observation_owner(self) -> Batch | CustomFunctions:
        """What has the observations."""
        return self._batch if self._custom is None else self._custom

    @property
    def last_observations(self) -> npt.NDArray[np.float32]:
        """(environments, entries) the observations of the last reset or step; not a copy."""
        return self._observation_owner.observations

    #: Input of the action 1 [V].
    max_input: Any = ReadOnlyOption("max_input", "experiment.max_input")

    #: Samples of an episode that no limit ends.
    horizon: Any = ReadOnlyOption("horizon", "experiment.samples")

    @property
    def spec(self) -> EnvSpec | None:
        """What the environment was made from."""
        return self._spec

    @spec.setter
    def spec(self, spec: EnvSpec | None) -> None:
        if spec is not None:
            spec_fields = {field.name: getattr(spec, field.name) for field in fields(EnvSpec) if field.init}
            # As JSON can hold it.
            modes = {name: mode.value for name, mode in spec.kwargs.items() if isinstance(mode, AutoresetMode)}
            spec_fields["kwargs"] = {**spec.kwargs, **modes}
            if spec_fields["max_episode_steps"] is None or isinstance(
                spec_fields["max_episode_steps"], _DefaultEpisodeSteps
            ):
                steps, limit = -(-self.experiment.samples // self.experiment.hold), spec.kwargs.get("max_episode_steps")
                # A vector environment has the limit that was asked for among its options.
                spec_fields["max_episode_steps"] = _DefaultEpisodeSteps(
                    min(steps, limit) if limit and limit > 0 else steps
                )
            spec = TrackSpec(**spec_fields)
        self._spec = spec


class UnknownOption(TypeError, ValueError):
    """A keyword that is no option: in the words of Python's own TypeError, which some trainers look for."""


def make_experiment(experiment_class: type[Experiment], options: dict[str, Any]) -> Experiment:
    """An experiment from keyword arguments.

    Raises:
        UnknownOption: for an unknown one, with the nearest known.
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
    """Refuse a call of a method while another call that is in turn has not returned; nothing has changed then.

    Two threads that step at once would mix two steps into one. The object has a list ``_call_token`` of one entry, which a
    call takes out and puts back: a lock that can be copied.

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
