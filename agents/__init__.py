"""Who chooses the input: excitation signals, learned policies, training and evaluation."""

from agents.policies import POLICIES, Policy, make_policy

__all__ = ["POLICIES", "Policy", "make_policy"]
