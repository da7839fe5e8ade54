"""Designs of whole blocks: what a policy chooses without seeing their outputs."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

import numpy as np

from agents.planner.blocks import best_block, drafts, systems_of
from agents.planner.futures import Futures
from agents.planner.policy import Planner
from agents.policies import Policy
from agents.policies.signals import SignalPolicy
from agents.running.follower import Follower
from agents.running.observed import Observed
from agents.running.session import Tripped
from estimator.parameters import FloatArray

#: Inputs (samples,) in the belief's scale, the share of what was wanted that they are, the probability of leaving.
Block = tuple[FloatArray, float, float]


class Design(Protocol):
    """What chooses blocks."""

    def block(self, samples: int, futures: Futures, bound: float) -> Block:
        """Inputs on the belief as it is observed, of which fewer futures than the bound leave the limit."""
        ...


class SignalDesign:
    """Blocks of a signal, one after the other, each as large as it is safe."""

    def __init__(self, policy: SignalPolicy, observed: Observed) -> None:
        self._policy, self._observed = policy, observed
        self._state: Any = None

    def block(self, samples: int, futures: Futures, bound: float) -> Block:
        """The next samples of the signal."""
        u, blind = np.empty(samples), np.zeros(1)
        for k in range(samples):
            action, self._state = self._policy.predict(blind, self._state)
            u[k] = self._observed.max_input * action[0]
        share, probability = futures.share(u, bound)
        return share * u, share, probability


class PlannedDesign:
    """Blocks that are planned for systems that are drawn from the belief (`agents.planner.blocks`).

    Args:
        planner: whose settings.
        observed: where the belief stands.
    """

    def __init__(self, planner: Planner, observed: Observed) -> None:
        self._planner, self._observed, self._rng = planner, observed, np.random.default_rng(planner.seed)

    def block(self, samples: int, futures: Futures, bound: float) -> Block:
        """The best block; it is planned as if it were the last."""
        planner, belief = self._planner, self._observed.belief
        systems = systems_of(planner.view, belief, futures, samples)
        begun = drafts(planner, belief.record, samples, int(self._rng.integers(2**63)))
        return best_block(planner.view, systems, futures, begun, planner.terms.amplitude, bound)


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


def designed(
    design: Design, follower: Follower, observed: Observed, samples: int, bound: float, rng: np.random.Generator,
    note: Callable[..., None],
) -> FloatArray:  # fmt: skip
    """A block in the rig's unit that is safe enough on what a run believes now.

    Args:
        design: of the block.
        follower: of the run.
        observed: what the design looks at.
        samples: of the block.
        bound: of the probability that it leaves the output's range.
        rng: of the systems that are drawn.
        note: is told share and probability.

    Raises:
        Tripped: if the belief says that even without input the output leaves its range with more than the bound.
    """
    estimator, observed.belief = follower.estimator, follower.belief
    futures = Futures(estimator.model, follower.drawn(rng), observed.experiment.max_output, rng, follower.delay)
    u, share, probability = design.block(samples, futures, bound)
    note("design", share=share, probability=probability)
    if share == 0.0 and probability >= bound:
        raise Tripped(
            "design",
            f"even without input the output would leave its range with probability {probability:.2g}, and at most "
            f"{bound:.2g} is allowed; give a narrower guess or a wider range",
        )
    return np.clip(u, -observed.max_input, observed.max_input) * estimator.scales.input
