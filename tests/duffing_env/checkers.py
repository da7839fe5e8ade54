"""The environment checkers of Gymnasium and Stable-Baselines3, which are not even to warn."""

from collections.abc import Callable
from typing import Any

from gymnasium.utils.env_checker import check_env as gymnasium_check


def assert_checkers_are_content(make: Callable[[], Any]) -> None:
    """Both take a new environment; a warning is an error in all tests."""
    from stable_baselines3.common.env_checker import check_env as sb3_check

    gymnasium_check(make().unwrapped, skip_render_check=True)
    sb3_check(make())
