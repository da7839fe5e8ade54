"""Checks of the arguments of `predict`: observation, state and episode starts."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from estimator.support.argument_checks import short_repr, to_float_array

#: Samples of a signal, or of a run, at most: two hours of the Silverbox's.
MAX_SAMPLES = 2**22


def check_state(state: Any, n_arrays: int) -> None:
    """Refuse a state that is not a tuple of ``n_arrays`` arrays."""
    parts = state if isinstance(state, tuple) else (state,)
    if len(parts) != n_arrays or not all(isinstance(part, np.ndarray) and part.ndim for part in parts):
        raise ValueError(f"state must be what the last call returned, or None, but is {short_repr(state)}")


def check_last_observation(env: Any, observations: npt.NDArray[Any]) -> None:
    """Refuse observations (n, entries) that an environment did not show last: its beliefs are not theirs.

    Args:
        env: whose beliefs a policy reads; its ``last_observations`` is what it showed last.
        observations: what the policy is asked about.

    Raises:
        ValueError: naming the first entry that differs.
    """
    last = env.last_observations
    if observations.shape == last.shape:
        same = observations == last
        if same.all():
            return
        row, entry = np.argwhere(~same)[0].tolist()
        given = (
            f"entry {entry} of environment {row} is {observations[row, entry]:.9g} in place of {last[row, entry]:.9g}"
        )
    else:
        given = f"has shape {observations.shape} in place of {last.shape}"
    raise ValueError(
        f"observation must be what the environment of this policy showed last, but {given}; the policy reads that "
        "environment's belief and is no function of the observation, so make it for the environment that is played, "
        "as make_policy(name, env), without wrappers that change or delay observations, and call predict between steps"
    )


def check_observation_size(observations: npt.NDArray[Any], size: int) -> None:
    """Refuse observations (entries,) or (n, entries) of another shape."""
    if observations.ndim not in (1, 2) or observations.shape[-1] != size:
        raise ValueError(f"observation must have {size} entries, but has shape {observations.shape}")


def check_observation_finite(observations: npt.NDArray[Any]) -> None:
    """Refuse observations with a number that is not finite."""
    if not np.isfinite(observations).all():
        raise ValueError(f"observation must be finite, but is {observations[~np.isfinite(observations)][0]} somewhere")


def check_batch_size(name: str, given: int, expected: int) -> None:
    """Refuse what is for another number of environments than the observation."""
    if given != expected:
        raise ValueError(
            f"{name} must be for as many environments as observation, {expected}, but is for {given}; pass None when "
            "the batch changes"
        )


def episode_starts(episode_start: npt.ArrayLike | None, n_environments: int) -> npt.NDArray[np.bool_]:
    """Which of some environments begin an episode (rows,): none where it is None.

    Raises:
        ValueError: for what is no such array.
    """
    if episode_start is None:
        return np.zeros(n_environments, dtype=np.bool_)
    starting = np.atleast_1d(to_float_array("episode_start", episode_start)) != 0
    if starting.ndim != 1:
        raise ValueError(f"episode_start must have shape ({n_environments},), but has {starting.shape}")
    check_batch_size("episode_start", len(starting), n_environments)
    return starting
