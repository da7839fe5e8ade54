"""Ids of tracks: the full id by a short name, the check that a track can be run here, and a rig among its options."""

from __future__ import annotations

from typing import Any

from agents.user_code import env_spec_of

#: Id of the track of a rig.
RIG_TRACK = "duffing_env/Rig-v0"


def options_with_rig(options: dict[str, Any], rig: str | None) -> dict[str, Any]:
    """Add a rig, by its file or its name, to the options of an environment.

    Raises:
        ValueError: for a file that is no rig file.
        FileNotFoundError: if there is no such file.
    """
    if rig is None:
        return options
    from estimator.rigs.rig import Rig

    return {**options, "rig": Rig.from_any(rig).to_dict()}


def full_track_id(env_id: Any) -> Any:
    """The full id of a track, without the module that registers it; other ids stay as they are.

    Example:
        >>> full_track_id("Short-v0"), full_track_id("duffing_env:duffing_env/Short-v0"), full_track_id("CartPole-v1")
        ('duffing_env/Short-v0', 'duffing_env/Short-v0', 'CartPole-v1')
    """
    from duffing_env import TRACKS

    env_id = env_id.removeprefix("duffing_env:") if isinstance(env_id, str) else env_id
    return f"duffing_env/{env_id}" if f"duffing_env/{env_id}" in TRACKS else env_id


def check_is_duffing_track(env_id: str) -> None:
    """Refuse an id that is no track: training and evaluation need a vector environment of duffing_env.

    Raises:
        ValueError: for an environment of another package, or one that cannot be imported.
        gymnasium.error.Error: for an id that is not registered.
    """
    import gymnasium as gym
    from gymnasium.envs.registration import load_env_creator

    from duffing_env import TRACKS
    from duffing_env.vector_env import DuffingVectorEnv
    from estimator.support.argument_checks import did_you_mean, short_repr

    if not isinstance(env_id, str):
        raise ValueError(f"env must be the id of a track such as duffing_env/Short-v0, but is {short_repr(env_id)}")
    try:
        vector_env_class: Any = env_spec_of(env_id).vector_entry_point
        vector_env_class = load_env_creator(vector_env_class) if isinstance(vector_env_class, str) else vector_env_class
    except (ImportError, AttributeError) as error:
        raise ValueError(
            f"env must be the id of a track such as duffing_env/Short-v0, but is {env_id}: {error}"
        ) from error
    except gym.error.Error as error:
        remedy = "" if "/" in env_id else did_you_mean(f"duffing_env/{env_id}", TRACKS)
        raise type(error)(
            f"env must be the id of a track such as duffing_env/Short-v0: {str(error).rstrip('.')}{remedy}"
        ) from error
    if vector_env_class is None or (
        isinstance(vector_env_class, type) and not issubclass(vector_env_class, DuffingVectorEnv)
    ):
        raise ValueError(
            f"env must be a track, which has a vector environment of duffing_env, but is {env_id}; "
            "see the list at: python -c 'import duffing_env; print(*duffing_env.TRACKS)'"
        )
