"""A run block by block, for rigs that are too fast for a program and play tables of inputs.

A `BlockDesigner` chooses a whole block before any of its outputs is measured.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple, Protocol

import numpy as np

from agents.hardware.clock import Clock
from agents.hardware.env_view import EnvView
from agents.hardware.recording import EventLog, Recording, SampleRow
from agents.hardware.run_estimator import RunEstimator
from agents.hardware.safety_session import SafetyStop, Session, StopReason
from agents.planning.open_loop.chance_constrained_block import optimise_block, sampled_systems
from agents.planning.open_loop.initial_guesses import initial_guesses
from agents.planning.open_loop.posterior_samples import MonteCarloSystems
from agents.policies import Policy
from agents.policies.efe_planner import EfePlanner
from agents.policies.signals import SignalPolicy
from estimator.models.single_input import check_single_input
from estimator.support.array_types import FloatArray


class ScaledBlock(NamedTuple):
    """A block of inputs that is scaled down until it is safe.

    Attributes:
        inputs: (samples,) in the belief's scale.
        scale: the factor, from 0 to 1, by which the inputs that were wanted are multiplied.
        exit_probability: probability that the output leaves its range.
    """

    inputs: FloatArray
    scale: float
    exit_probability: float


class BlockDesigner(Protocol):
    """Chooses blocks of inputs."""

    def design_block(self, samples: int, futures: MonteCarloSystems, bound: float) -> ScaledBlock:
        """A block for the present belief, whose probability of leaving the range is below the bound."""
        ...


class SignalBlockDesigner:
    """Blocks of a signal, one after the other, each scaled down until it is safe."""

    def __init__(self, policy: SignalPolicy, env_view: EnvView) -> None:
        self._policy, self._env_view = policy, env_view
        self._state: Any = None

    def design_block(self, samples: int, futures: MonteCarloSystems, bound: float) -> ScaledBlock:
        """The next samples of the signal."""
        u, empty_observation = np.empty(samples), np.zeros(1)
        for k in range(samples):
            action, self._state = self._policy.predict(empty_observation, self._state)
            u[k] = self._env_view.max_inputs[0] * action[0]
        scale, probability = futures.safe_scale(u, bound)
        return ScaledBlock(scale * u, scale, probability)


class PlannedBlockDesigner:
    """Blocks that are planned for systems drawn from the belief (`planning.open_loop.chance_constrained_block`)."""

    def __init__(self, planner: EfePlanner, env_view: EnvView) -> None:
        self._planner, self._env_view, self._rng = planner, env_view, np.random.default_rng(planner.seed)

    def design_block(self, samples: int, futures: MonteCarloSystems, bound: float) -> ScaledBlock:
        """The best block; it is planned as the last one."""
        planner, belief = self._planner, self._env_view.belief
        systems = sampled_systems(planner.model_view, belief, futures, samples)
        starting_inputs = initial_guesses(planner.settings, belief.record, samples, int(self._rng.integers(2**63)))
        return ScaledBlock(
            *optimise_block(planner.model_view, systems, futures, starting_inputs, planner.objective.amplitude, bound)
        )


def block_designer(policy: Policy, env_view: EnvView) -> BlockDesigner:
    """The designer of a policy's blocks.

    Raises:
        ValueError: for a policy that responds to every sample, or several inputs.
    """
    check_single_input(
        "signals and blocks on a rig, whose safety is simulated with a disturbance of one input",
        env_view.experiment.model,
        "pass a policy of your own that chooses each sample, module:name",
    )
    if isinstance(policy, SignalPolicy):
        return SignalBlockDesigner(policy, env_view)
    if isinstance(policy, EfePlanner):
        return PlannedBlockDesigner(policy, env_view)
    raise ValueError(
        f"policy must be a signal or the planner efe to be played in blocks, but is a {type(policy).__name__}, which "
        "responds to every sample; choose another, or run sample by sample"
    )


def design_safe_block(
    designer: BlockDesigner,
    run_estimator: RunEstimator,
    env_view: EnvView,
    samples: int,
    bound: float,
    rng: np.random.Generator,
    log_event: EventLog,
) -> FloatArray:
    """A block, in the rig's unit, that takes the output out of its range with a probability below the bound.

    The probability is under the present belief of the run. ``log_event`` gets the block's scale and probability.

    Raises:
        SafetyStop: if even without input the output leaves its range with a larger probability than the bound.
    """
    estimator, env_view.belief = run_estimator.online, run_estimator.belief
    futures = MonteCarloSystems(
        estimator.model, run_estimator.draw_systems(rng), env_view.experiment.max_output, rng, run_estimator.delay
    )
    u, scale, probability = designer.design_block(samples, futures, bound)
    log_event("design", share=scale, probability=probability)
    if scale == 0.0 and probability >= bound:
        raise SafetyStop(
            StopReason.DESIGN,
            f"even without input the output would leave its range with probability {probability:.2g}, and at most "
            f"{bound:.2g} is allowed; give a narrower guess or a wider range",
        )
    max_input = env_view.max_inputs[0]
    return np.clip(u, -max_input, max_input) * estimator.scales.input


class BlockLoop:
    """The loop of a run by blocks: design a block on the belief, play it, read the outputs, and update the belief.

    Between two blocks the input is zero for an unknown time. The first block is silent: from it the rig's state is
    estimated. A block leaves the output's range with a probability below ``bound``, in systems that ``rng`` draws from
    the belief.
    """

    def __init__(
        self,
        session: Session,
        run_estimator: RunEstimator,
        env_view: EnvView,
        recording: Recording,
        clock: Clock,
        step: float,
        bound: float,
        rng: np.random.Generator,
    ) -> None:
        self._session, self._run_estimator = session, run_estimator
        self._env_view, self._recording = env_view, recording
        self._clock, self._step, self._bound, self._rng = clock, step, bound, rng
        self._start_time = clock.now()
        self._block = self._n_rows = 0

    def listen(self, samples: int) -> None:
        """Play a silent block."""
        self._play(np.zeros(samples))

    def play(
        self, designer: BlockDesigner, samples: int, block_samples: int, on_progress: Callable[[int], None]
    ) -> None:
        """Design and play blocks.

        Args:
            designer: chooses the blocks.
            samples: number of inputs in all.
            block_samples: number of inputs in a block; the last block may be shorter.
            on_progress: called with the number of inputs after each block.

        Raises:
            SafetyStop: as of `design_safe_block`.
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
        samples = zip(applied.tolist(), y.tolist(), u.tolist(), strict=True)
        values = [*samples, (None, None, None)]  # the last row is the pause
        rows = [
            SampleRow(k, k * self._step, *value, self._block, 0, now) for k, value in enumerate(values, self._n_rows)
        ]
        self._recording.write_rows(rows)
        self._n_rows += len(u) + 1
        self._block += 1
        self._session.check_outputs(y)
        self._run_estimator.update_block(applied, y)
        self._run_estimator.start_pause(float(applied[-1]))
