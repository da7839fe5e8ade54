"""What single and vector environments share: spaces, options, specification, and that one call goes at a time."""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import fields
from functools import wraps
from typing import Any, TypeVar

import numpy as np
from gymnasium import spaces
from gymnasium.envs.registration import EnvSpec

from duffing_env.batch import Batch
from duffing_env.experiment import Experiment
from duffing_env.own import Own, bounds_of
from estimator.checks import hint
from estimator.parameters import FloatArray

Method = TypeVar("Method", bound=Callable[..., Any])


def observation_space(experiment: Experiment) -> spaces.Box:
    """The observation's space: a flat float32 Box with finite bounds."""
    low, high = bounds_of(experiment).T.astype(np.float32)
    return spaces.Box(low.copy(), high.copy(), dtype=np.float32)


def action_space() -> spaces.Box:
    """The action's space: the input in parts of the largest."""
    return spaces.Box(-1.0, 1.0, (1,), dtype=np.float32)


def checked_options(options: dict[str, Any] | None, *known: str) -> dict[str, Any]:
    """The options of a reset; ValueError for one that is not known, or what is not a dict."""
    if not isinstance(options, dict | None):
        raise ValueError(f"options of reset must be a dict or None, but are {options!r:.200}")
    for name in options or {}:
        if name not in known:
            raise ValueError(f"options of reset must be among {list(known)}, but there is {name!r}; remove it")
    return options or {}


class Specified:
    """What an environment, single or vector, tells of its experiment and beliefs, and its specification.

    The specification tells Gymnasium's wrappers after how many steps an episode ends. That is no part of what is
    registered, because Gymnasium would then cut a longer ``horizon`` short.
    """

    experiment: Experiment
    _batch: Batch
    _own: Own | None
    _spec: EnvSpec | None = None

    @property
    def records(self) -> FloatArray:
        """(environments, size) the posteriors now, as the flat records of `estimator.Belief`; a copy."""
        return self._batch.records()

    def mixture(self, index: int = 0) -> tuple[FloatArray, FloatArray]:
        """Records (m, size) and weights (m,) of the beliefs that one weighs: one, or one for each hypothesis."""
        return self._batch.mixture(index)

    @property
    def _seen(self) -> Batch | Own:
        """What has the observations."""
        return self._batch if self._own is None else self._own

    @property
    def max_input(self) -> float:
        """Input of the action 1 [V]."""
        return self.experiment.max_input

    @property
    def horizon(self) -> int:
        """Samples of an episode that no limit ends."""
        return self.experiment.samples

    @property
    def spec(self) -> EnvSpec | None:
        """What the environment was made from."""
        return self._spec

    @spec.setter
    def spec(self, spec: EnvSpec | None) -> None:
        if spec is not None and spec.max_episode_steps is None:
            spec = copy.copy(spec)
            spec.max_episode_steps = -(-self.experiment.samples // self.experiment.hold)
        self._spec = spec


class UnknownOption(TypeError, ValueError):
    """A keyword that is no option: in the words of Python's own TypeError, which some trainers look for."""


def make_experiment(kind: type[Experiment], options: dict[str, Any]) -> Experiment:
    """An experiment from keyword arguments.

    Raises:
        UnknownOption: for an unknown one, with the nearest known.
    """
    known = [field.name for field in fields(kind)]
    for name in options:
        if name not in known:
            raise UnknownOption(
                f"got an unexpected keyword argument {name!r}: the options of this environment are {known}"
                f"{hint(name, known)}"
            )
    return kind(**options)


def in_turn(method: Method) -> Method:
    """Refuse a call of a method while another call that is in turn has not returned; nothing has changed then.

    Two threads that step at once would mix two steps into one. The object has a list ``_turn`` of one entry, which a
    call takes out and puts back: a lock that can be copied.

    Raises:
        RuntimeError: for the second call.
    """

    @wraps(method)
    def called(self: Any, *args: Any, **kwargs: Any) -> Any:
        try:
            token = self._turn.pop()
        except IndexError:
            raise RuntimeError(
                f"{method.__name__} must wait until the last call of this environment has returned, but another thread "
                "called it meanwhile; give each thread an environment of its own"
            ) from None
        try:
            return method(self, *args, **kwargs)
        finally:
            self._turn.append(token)

    return called  # type: ignore[return-value]
