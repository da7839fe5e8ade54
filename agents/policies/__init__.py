"""Policies by name, with the `predict` of Stable-Baselines3: signals, feedback laws, planners, trained networks.

`make_policy("silverbox-multisine", env)` makes a policy that fits `env`. To add one, write a
function of the unwrapped environment (or None), the seed and its options, and name it in `POLICIES`.
"""

import inspect
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, Protocol

from gymnasium import Env
from gymnasium.vector import VectorEnv
from numpy.typing import ArrayLike, NDArray

from agents.policies.block_planner import BlockPlanner
from agents.policies.custom_policies import custom_policy, unwrap_vec_env
from agents.policies.efe_planner import EfePlanner
from agents.policies.excitations import EXCITATIONS
from agents.policies.feedback import FEEDBACK
from agents.policies.shield_baseline import ShieldBaseline
from agents.policies.signals import make_signal
from agents.user_code import load_object
from estimator.support.argument_checks import MAX_SEED, check_integer, did_you_mean, short_repr


class Policy(Protocol):
    """A policy: Stable-Baselines3's `predict`, on one observation or on a batch."""

    def predict(
        self, observation: Any, state: Any = None, episode_start: ArrayLike | None = None, deterministic: bool = False
    ) -> tuple[NDArray[Any], Any]:
        """Chooses the action.

        Args:
            observation: Shape `(n, features)`, or `(features,)` for one environment.
            state: What the last call returned, or None.
            episode_start: Shape `(n,)`: which environments begin an episode here.
            deterministic: Whether to take a stochastic policy's mode instead of a sample.

        Returns:
            The actions in [-1, 1], float32 of shape `(n, inputs)`, or `(inputs,)` for one environment; and
            the state for the next call.
        """
        ...


POLICIES: dict[str, Callable[..., Policy]] = {
    **{name: partial(make_signal, name) for name in EXCITATIONS},
    **FEEDBACK,
    "efe": EfePlanner,
    "efe-myopic": partial(EfePlanner, horizon=1),
    "shield": ShieldBaseline,
    **{f"efe-block-{n}": partial(BlockPlanner, block=n) for n in (16, 64, 256)},
}


#: Folder of the trained policies that ship with the package: ``ALGORITHM/TRACK``.
TRAINED = Path(__file__).parent / "trained"


def trained_policies() -> list[str]:
    """Names of the trained policies that ship with the package, such as `"ppo/amplitude"`."""
    return sorted(card.parent.relative_to(TRAINED).as_posix() for card in TRAINED.glob("*/*/policy.json"))


def path_exists(name: str) -> bool:
    """Whether there is a file or folder of this name; none has one that no file can have."""
    try:
        return Path(name).exists()
    except (OSError, ValueError):
        return False


def make_policy(name: Any, env: Env | VectorEnv | None = None, *, seed: int = 0, **options: Any) -> Policy:
    """Makes the policy of this name, or of a thing of your own.

    Args:
        name: A name in `POLICIES`, one of `trained_policies()` such as `"ppo/amplitude"`, the path of a
            trained policy (`runs/...`), or `module:name` of a thing of your own; or that thing itself. It may be
            an object that has `predict`, such as a model of Stable-Baselines3, whose `VecNormalize` is not
            forgotten; a class, which is called with those of `env`, `seed` and the options that it takes by
            name; or a function of observations (n, features) that gives actions (n, inputs), such as a module of torch.
        env: The environment it is for, single or vector, wrapped or not, or a `VecEnv` of Stable-Baselines3 around
            it: it gives the amplitude limit, the episode's length and, where it replays a record, the recorded
            input. Planners read its belief and model, do not play without it, and refuse observations
            that it did not show last. None: a Duffing track with a limit of 0.15 V.
        seed: The seed of the policy's own randomness; of a trained policy, the seed of its sampled actions.
        options: Further options of a policy that has some, such as `horizon=8` of `"efe"`; a
            trained policy has none.

    Returns:
        The policy.

    Raises:
        ValueError: There is neither a policy nor a file of this name, it has no such option, it is no
            policy, or `env` is not one of duffing_env; or is a `VecNormalize` that changes observations, under
            which only signals play.
    """
    check_integer("seed", seed, MAX_SEED, 0)
    name = str(name) if isinstance(name, Path) else name
    if not isinstance(name, str):
        return custom_policy(name, env, seed, options)
    is_custom = ":" in name and name not in POLICIES and not path_exists(name)
    env = env if is_custom else unwrap_vec_env(env, name in EXCITATIONS)
    if name in POLICIES:
        make = POLICIES[name]
        known_names = [o for o in inspect.signature(make).parameters if o not in ("regime", "env", "seed")]
        for option, value in options.items():
            if option not in known_names:
                raise ValueError(f"{option}={value!r} is no option of policy {name!r}, which has {known_names}")
        return make(env if env is None else env.unwrapped, seed, **options)
    if is_custom:
        return custom_policy(load_object(name, "policy"), env, seed, options)
    if options:
        raise ValueError(f"options must be none for a trained policy, but are {options}; leave them out")
    if name in trained_policies() or path_exists(name):
        from agents.policies.networks.trained_policy import load_policy

        policy = load_policy(TRAINED / name if name in trained_policies() else name, seed)
        if env is not None:
            policy.adapt_to(env.unwrapped)
        return policy
    known_names = [*POLICIES, *trained_policies()]
    raise ValueError(
        f"policy must be one that is known, the path of a trained one, or module:name of your own, but is "
        f"{short_repr(name)}{did_you_mean(name, known_names)}; known are {', '.join(known_names)}"
    )
