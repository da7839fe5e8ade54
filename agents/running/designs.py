"""Designs of whole blocks: what a policy chooses without seeing their outputs."""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np

from agents.planner.policy import Planner
from agents.planner.search import search
from agents.policies import Policy
from agents.policies.signals import SignalPolicy
from agents.running.observed import Observed
from estimator.parameters import FloatArray


class Design(Protocol):
    """What chooses blocks."""

    def block(self, samples: int) -> FloatArray:
        """Inputs (samples,) on the belief as it is observed, in its scale."""
        ...


class SignalDesign:
    """Blocks of a signal, one after the other."""

    def __init__(self, policy: SignalPolicy, observed: Observed) -> None:
        self._policy, self._observed = policy, observed
        self._state: Any = None

    def block(self, samples: int) -> FloatArray:
        """The next samples of the signal."""
        u, blind = np.empty(samples), np.zeros(1)
        for k in range(samples):
            action, self._state = self._policy.predict(blind, self._state)
            u[k] = self._observed.max_input * action[0]
        return u


class PlannedDesign:
    """Blocks that the planner plays on the belief, its means for the truth, with what it expects to learn on the way.

    Args:
        planner: whose settings.
        observed: where the belief stands.
    """

    def __init__(self, planner: Planner, observed: Observed) -> None:
        self._planner, self._observed = planner, observed
        self._words = np.random.SFC64(planner.seed).state["state"]["state"]

    def block(self, samples: int) -> FloatArray:
        """Plan sample by sample in imagination; a block is planned as if it were the last."""
        planner, u, record = self._planner, np.zeros(samples), self._observed.records[0]
        horizon = min(planner.horizon, samples)
        search(*planner.view).play(record, 0, horizon, planner.rounds, planner.terms, u, self._words)
        return u


def design_of(policy: Policy, observed: Observed) -> Design:
    """How blocks of a policy are designed.

    Raises:
        ValueError: for a policy that answers to every sample.
    """
    if isinstance(policy, SignalPolicy):
        return SignalDesign(policy, observed)
    if isinstance(policy, Planner):
        return PlannedDesign(policy, observed)
    raise ValueError(
        f"policy must be a signal or the planner efe to be played in blocks, but is a {type(policy).__name__}, which "
        "answers to every sample; choose another, or run sample by sample"
    )
