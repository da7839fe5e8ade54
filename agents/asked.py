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
