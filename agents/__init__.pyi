# Public names of `agents`, for type checkers and for `__init__.py`, which imports each at its first use.
from .policies import POLICIES, Policy, make_policy
from .policies.networks.policy_saving import save_policy

__all__ = ["POLICIES", "Policy", "make_policy", "save_policy"]
