"""What chooses the inputs of a run: policies that answer to every sample, and designs of whole blocks."""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np

from agents.planner.motion import resonances, survey
from agents.planner.policy import Planner
from agents.planner.search import search
from agents.policies import EXCITATIONS, Policy, make_policy
from agents.policies.excitations import Draw
from agents.policies.signals import DEFAULT_MAX_INPUT, SignalPolicy
from agents.running.observed import Observed
from estimator.belief import Belief
from estimator.parameters import FloatArray

#: Cycles per sample at which the excitations' bands and holds look for a resonance: the Silverbox's.
_OF_EXCITATIONS = 68.1 * 1.6384e-3


def policy_of(name: str, observed: Observed, seed: int) -> Policy:
    """The policy of this name (`agents.make_policy`), for a run.

    Signals are made for the Silverbox's resonance. Here each of their values is held for as many samples as the
    rig's resonance, as it is believed, is slower; and their limit is the rig's.

    Raises:
        ValueError: if there is none of this name, or it needs something that a run has not.
    """
    if name not in EXCITATIONS:
        return make_policy(name, observed, seed=seed)  # type: ignore[arg-type]
    hold = holds(observed.belief, observed.horizon)
    draw = _held(EXCITATIONS[name](DEFAULT_MAX_INPUT), hold, observed.max_input / DEFAULT_MAX_INPUT)
    return SignalPolicy(name, draw, max_input=observed.max_input, samples=observed.horizon, seed=seed)


def holds(belief: Belief, samples: int) -> int:
    """Samples to hold each value of an excitation for, at least 1, so that it excites what is believed."""
    means = belief.coefficients_mean
    found = survey(belief.model, means, np.zeros(belief.model.n_states))
    cycles = float(resonances(belief.model, found.slopes)[0])
    if cycles <= 0.0:  # two wells: the frequency at the bottom of one
        stiffness = dict(zip(belief.names, means, strict=True)).get("stiffness", 0.0)
        cycles = np.sqrt(2.0 * abs(stiffness)) / (2.0 * np.pi)
    longest = max(1, samples // 8)
    return int(np.clip(round(_OF_EXCITATIONS / max(cycles, 1e-9)), 1, longest))


def _held(draw: Draw, hold: int, worth: float) -> Draw:
    """A draw that is slower, and in another unit."""

    def slower(rng: np.random.Generator, samples: int) -> FloatArray:
        # Below 5 samples a multisine has no line in its band.
        values: FloatArray = np.repeat(worth * draw(rng, max(5, -(-samples // hold))), hold)[:samples]
        return values

    return slower


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
