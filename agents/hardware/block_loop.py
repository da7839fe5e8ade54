"""A run block by block: for rigs that are too fast for a program, and play tables.

A *design* chooses a whole block, without seeing its outputs.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, Protocol

import numpy as np

from agents.hardware.clock import Clock
from agents.hardware.env_view import EnvView
from agents.hardware.recording import Recording
from agents.hardware.run_estimator import RunEstimator
from agents.hardware.safety_session import SafetyStop, Session
from agents.planning.open_loop.chance_constrained_block import optimise_block, sampled_systems
from agents.planning.open_loop.initial_guesses import initial_guesses
from agents.planning.open_loop.posterior_samples import MonteCarloSystems
from agents.policies import Policy
from agents.policies.efe_planner import EfePlanner
from agents.policies.signals import SignalPolicy
from estimator.support.array_types import FloatArray

#: Inputs (samples,) in the belief's scale, the share of what was wanted that they are, the probability of leaving.
ScaledBlock = tuple[FloatArray, float, float]


class BlockDesigner(Protocol):
    """What chooses blocks."""

    def block(self, samples: int, futures: MonteCarloSystems, bound: float) -> ScaledBlock:
        """Inputs on the belief as it is observed, of which fewer futures than the bound leave the limit."""
        ...


class SignalBlockDesigner:
    """Blocks of a signal, one after the other, each as large as it is safe."""

    def __init__(self, policy: SignalPolicy, env_view: EnvView) -> None:
        self._policy, self._env_view = policy, env_view
        self._state: Any = None

    def block(self, samples: int, futures: MonteCarloSystems, bound: float) -> ScaledBlock:
        """The next samples of the signal."""
        u, empty_observation = np.empty(samples), np.zeros(1)
        for k in range(samples):
            action, self._state = self._policy.predict(empty_observation, self._state)
            u[k] = self._env_view.max_input * action[0]
        share, probability = futures.safe_scale(u, bound)
        return share * u, share, probability


class PlannedBlockDesigner:
    """Blocks that are planned for systems that are drawn from the belief (`agents.planning.open_loop.chance_constrained_block`)."""

    def __init__(self, planner: EfePlanner, env_view: EnvView) -> None:
        self._planner, self._env_view, self._rng = planner, env_view, np.random.default_rng(planner.seed)

    def block(self, samples: int, futures: MonteCarloSystems, bound: float) -> ScaledBlock:
        """The best block; it is planned as if it were the last."""
        planner, belief = self._planner, self._env_view.belief
        systems = sampled_systems(planner.model_view, belief, futures, samples)
        starting_inputs = initial_guesses(planner.settings, belief.record, samples, int(self._rng.integers(2**63)))
        return optimise_block(planner.model_view, systems, futures, starting_inputs, planner.objective.amplitude, bound)


def block_designer(policy: Policy, env_view: EnvView) -> BlockDesigner:
    """How blocks of a policy are designed.

    Raises:
        ValueError: for a policy that answers to every sample.
    """
    if isinstance(policy, SignalPolicy):
        return SignalBlockDesigner(policy, env_view)
    if isinstance(policy, EfePlanner):
        return PlannedBlockDesigner(policy, env_view)
    raise ValueError(
        f"policy must be a signal or the planner efe to be played in blocks, but is a {type(policy).__name__}, which "
        "answers to every sample; choose another, or run sample by sample"
    )


def design_safe_block(
    designer: BlockDesigner, run_estimator: RunEstimator, env_view: EnvView, samples: int, bound: float, rng: np.random.Generator,
    log_event: Callable[..., None],
) -> FloatArray:  # fmt: skip
    """A block in the rig's unit that leaves the range with less than the bound, on what a run believes now.

    ``log_event`` is told share and probability.

    Raises:
        Tripped: if the belief says that even without input the output leaves its range with more than the bound.
    """
    estimator, env_view.belief = run_estimator.online, run_estimator.belief
    futures = MonteCarloSystems(
        estimator.model, run_estimator.draw_systems(rng), env_view.experiment.max_output, rng, run_estimator.delay
    )
    u, scale, probability = designer.block(samples, futures, bound)
    log_event("design", share=scale, probability=probability)
    if scale == 0.0 and probability >= bound:
        raise SafetyStop(
            "design",
            f"even without input the output would leave its range with probability {probability:.2g}, and at most "
            f"{bound:.2g} is allowed; give a narrower guess or a wider range",
        )
    return np.clip(u, -env_view.max_input, env_view.max_input) * estimator.scales.input


class BlockLoop:
    """Designs blocks on the belief, plays them, reads back, and updates.

    Between two blocks the input is zero for a time that nobody knows. The first block is silent: it tells where the rig
    stands. A block leaves the output's range with less than the ``bound``, in systems that ``rng`` draws of the belief.
    """

    def __init__(
        self, session: Session, run_estimator: RunEstimator, env_view: EnvView, recording: Recording, clock: Clock, step: float,
        bound: float, rng: np.random.Generator,
    ) -> None:  # fmt: skip
        self._session, self._run_estimator, self._env_view, self._recording = (
            session,
            run_estimator,
            env_view,
            recording,
        )
        self._clock, self._step, self._bound, self._rng = clock, step, bound, rng
        self._start_time = clock.now()
        self._block = self._n_rows = 0

    def listen(self, samples: int) -> None:
        """Play a silent block."""
        self._play(np.zeros(samples))

    def play(
        self, designer: BlockDesigner, samples: int, block_samples: int, on_progress: Callable[[int], None]
    ) -> None:
        """Play so many samples, in blocks of which the last may be shorter.

        ``on_progress`` is called with the number of samples after each.

        Raises:
            Tripped: as `design_safe_block`.
        """
        done = 0
        while done < samples:
            count = min(block_samples, samples - done)
            log_event = partial(self._recording.log_event, block=self._block)
            self._play(
                design_safe_block(
                    designer, self._run_estimator, self._env_view, count, self._bound, self._rng, log_event
                )
            )
            done += count
            on_progress(done)

    def _play(self, u: FloatArray) -> None:
        applied, y = self._session.play(u)
        now = self._clock.now() - self._start_time
        rows = [
            (self._n_rows + k, (self._n_rows + k) * self._step, applied[k], y[k], u[k], self._block, 0, now, None)
            for k in range(len(u))
        ]
        pause_row = (
            self._n_rows + len(u),
            (self._n_rows + len(u)) * self._step,
            None,
            None,
            None,
            self._block,
            0,
            now,
            None,
        )
        self._recording.write_rows(
            [[float(v) if isinstance(v, np.floating) else v for v in row] for row in [*rows, pause_row]]
        )
        self._n_rows += len(u) + 1
        self._block += 1
        self._session.check(y)
        self._run_estimator.update_block(applied, y)
        self._run_estimator.start_pause(float(applied[-1]))
