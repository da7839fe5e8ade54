"""Policies and groups of training seeds in an evaluation: their titles, and checks that they can play."""

from __future__ import annotations

import glob
import inspect
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from agents.evaluation.track_batch import make_track_batch
from agents.policies import make_policy
from agents.policies.networks.trained_policy import CARD_FILE
from agents.user_code import attribute_user_errors


def policy_title(policy: Any) -> str:
    """The title of a policy in tables."""
    if isinstance(policy, str):
        return policy
    known = getattr(policy, "name", None) or getattr(policy, "__name__", None) or type(policy).__name__
    return str(known)


def policy_group(policy: Any) -> tuple[str | None, list[Any]]:
    """The title and the members of a group TITLE=PATTERN; a single policy has the title None.

    Raises:
        ValueError: for a pattern that matches fewer than two policy folders.
    """
    if not isinstance(policy, str):
        return None, [policy]
    title, equals, pattern = policy.partition("=")
    if not equals or Path(policy).exists():
        return None, [policy]
    folders = sorted(path for path in glob.glob(pattern) if (Path(path) / CARD_FILE).is_file())
    if not title or len(folders) < 2:
        raise ValueError(
            f"policies must name a group as TITLE=PATTERN, whose pattern two policy folders or more match, but "
            f"{policy!r} matches {folders}; write e.g. 'ppo=runs/ppo-amplitude-v0-*'"
        )
    return title, folders


def check_policies_can_play(policies: Sequence[Any], env_id: str, options: dict[str, Any], seed: int) -> None:
    """Refuse policies that cannot be made for an environment, before the first one plays, which takes long."""
    envs = make_track_batch(env_id, 2, options)
    for policy in policies:
        if isinstance(policy, str):
            try:
                with attribute_user_errors(policy, "policy"):
                    made = make_policy(policy, envs, seed=seed)
                check_predict_signature(made, policy)
            except ValueError as error:
                raise ValueError(f"{policy}: {error}") from error
    envs.close()


def check_predict_signature(policy: Any, name: Any) -> None:
    """Refuse a policy object whose ``predict`` cannot be called with the arguments of `agents.Policy`."""
    try:
        signature = inspect.signature(policy.predict)
    except ValueError:  # a builtin has no signature
        return
    try:
        signature.bind(None, None, None, deterministic=True)
    except TypeError as error:
        raise ValueError(
            f"policy {policy_title(name)} must have predict(observation, state, episode_start, deterministic), but its "
            f"predict is {signature}: {error}; give it those"
        ) from error
