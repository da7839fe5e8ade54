# The names of `agents`, for type checkers and for its `__init__.py`, which fetches each when it is asked for.
from .policies import POLICIES, Policy, make_policy
from .policies.networks.policy_saving import save_policy

__all__ = ["POLICIES", "Policy", "make_policy", "save_policy"]
