"""What a policy is asked, checked: the state of the last call, which episodes begin, and how long a signal may be."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from estimator.checks import numbers, shown

#: Samples of a signal, or of a run, at most: two hours of the Silverbox's.
MOST_SAMPLES = 2**22


def check_state(state: Any, arrays: int) -> None:
    """Refuse what no policy of so many arrays returned."""
    parts = state if isinstance(state, tuple) else (state,)
    if len(parts) != arrays or not all(isinstance(part, np.ndarray) and part.ndim for part in parts):
        raise ValueError(f"state must be what the last call returned, or None, but is {shown(state)}")


def check_shown(env: Any, observed: npt.NDArray[Any]) -> None:
    """Refuse observations (n, entries) that an environment did not show last: its beliefs are not theirs.

    Args:
        env: whose beliefs a policy reads; its ``last_observations`` is what it showed last.
        observed: what the policy is asked about.

    Raises:
        ValueError: naming the first entry that differs.
    """
    last = env.last_observations
    if observed.shape == last.shape:
        same = observed == last
        if same.all():
            return
        row, entry = np.argwhere(~same)[0].tolist()
        given = f"entry {entry} of environment {row} is {observed[row, entry]:.9g} in place of {last[row, entry]:.9g}"
    else:
        given = f"has shape {observed.shape} in place of {last.shape}"
    raise ValueError(
        f"observation must be what the environment of this policy showed last, but {given}; the policy reads that "
        "environment's belief and is no function of the observation, so make it for the environment that is played, "
        "as make_policy(name, env), without wrappers that change or delay observations, and call predict between steps"
    )


def check_entries(observed: npt.NDArray[Any], entries: int) -> None:
    """Refuse observations (entries,) or (n, entries) of another shape."""
    if observed.ndim not in (1, 2) or observed.shape[-1] != entries:
        raise ValueError(f"observation must have {entries} entries, but has shape {observed.shape}")


def check_finite(observed: npt.NDArray[Any]) -> None:
    """Refuse observations with a number that is not finite."""
    if not np.isfinite(observed).all():
        raise ValueError(f"observation must be finite, but is {observed[~np.isfinite(observed)][0]} somewhere")


def check_rows(name: str, given: int, expected: int) -> None:
    """Refuse what is for another number of environments than the observation."""
    if given != expected:
        raise ValueError(
            f"{name} must be for as many environments as observation, {expected}, but is for {given}; pass None when "
            "the batch changes"
        )


def starts(episode_start: npt.ArrayLike | None, rows: int) -> npt.NDArray[np.bool_]:
    """Which of some environments begin an episode (rows,): none where it is None.

    Raises:
        ValueError: for what is no such array.
    """
    if episode_start is None:
        return np.zeros(rows, dtype=np.bool_)
    begun = np.atleast_1d(numbers("episode_start", episode_start)) != 0
    if begun.ndim != 1:
        raise ValueError(f"episode_start must have shape ({rows},), but has {begun.shape}")
    check_rows("episode_start", len(begun), rows)
    return begun
