"""The expected free energy planner: it imagines what candidate inputs would teach, and applies the best one's first.

Of a sequence of inputs u over the next H samples the expected free energy is, in nats,

    G(u) = -[½ log det C_0 - ½ log det C_H(u)]                          what it teaches (epistemic)
           + Σ_h E[(x_h - goal)²] / (2 goal_std²)                       how far it is from a goal (pragmatic, optional)
           + input_cost Σ_h u_h²                                        what it costs (optional)

with C_0 the covariance of (θ, η) now and C_H the one after the H outputs that are expected, by belief propagation: the
joint posterior of state and coefficients is updated along the imagined trajectory, so what one sample teaches is not
counted again by the next. The teaching part then telescopes: a plan of the whole episode would be Bayesian D-optimal.

A displacement x_h must stay within the limit by ``margin`` standard deviations of the output that is then predicted;
plans that do not are the worse the further they go beyond.

The search is a local one (`agents.policies.planning`): the last plan, shifted by one sample, is mutated in rounds of
`estimator.lanes.LANES` candidates, each round from the best so far. Under an amplitude limit the best inputs are nearly
all at their limit, so candidates are sequences of signs, now and then with a value between. Horizon 1 is myopic.

Where the input's energy is limited (``max_rms`` of the environment), the plan is for the whole rest of the episode, and
climbs by gradient (`agents.policies.pursuit`): then the question is when to spend, which no short horizon can answer.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from agents.policies.planning import plan
from agents.policies.pursuit import pursue
from estimator.parameters import FloatArray

#: The last plans (n, horizon) in V, and the streams of random numbers (n, 4).
PlannerState = tuple[FloatArray, npt.NDArray[np.uint64]]

#: Samples to plan for under an amplitude limit: more than a period of the oscillator.
_HORIZON = 12

# Places in the observation.
_TIME_LEFT, _BUDGET_LEFT = 20, 21


class Planner:
    """Expected free energy planning on the beliefs of an environment.

    Environment i searches with a stream of random numbers of its own, the i-th child of the seed, so that its inputs
    do not depend on the size of the batch.

    Args:
        env: the unwrapped environment, single or vector, whose beliefs it reads: `predict` must be called between
            its steps, with its observations.
        seed: of the search.
        horizon: samples to plan for; by default 12, and the whole episode where the energy is limited.
        rounds: of the search, `estimator.lanes.LANES` candidates each; of no effect on a plan of the whole episode.
        margin: standard deviations that a plan keeps from the displacement limit.
        goal: mean of the goal prior of the displacement [V].
        goal_std: its standard deviation [V]; no goal where it is None.
        input_cost: nats for a V² of input energy.

    Raises:
        ValueError: naming the argument, if there is no environment, it replays a record, holds its actions for several
            samples, a number is out of range, or a goal or cost is asked of a plan of the whole episode.
    """

    def __init__(
        self,
        env: Any,
        seed: int = 0,
        *,
        horizon: int | None = None,
        rounds: int = 24,
        margin: float = 4.0,
        goal: float = 0.0,
        goal_std: float | None = None,
        input_cost: float = 0.0,
    ) -> None:
        if not hasattr(env, "records") or hasattr(env, "recorded_input"):
            raise ValueError(
                f"env must be an environment of duffing_env that simulates a plant, but is {type(env).__name__}; "
                "the planner needs its beliefs: pass it to make_policy"
            )
        for name, count in (("horizon", 1 if horizon is None else horizon), ("rounds", rounds)):
            if not isinstance(count, int | np.integer) or count < 1:
                raise ValueError(f"{name} must be a whole number of at least 1, but is {count!r}")
        for name, value in (("margin", margin), ("input_cost", input_cost)):
            if not 0 <= value < np.inf:
                raise ValueError(f"{name} must be 0 or more and finite, but is {value!r}")
        if goal_std is not None and not 0 < goal_std < np.inf:
            raise ValueError(f"goal_std must be positive and finite, but is {goal_std!r}; None is no goal")
        experiment = env.experiment
        if experiment.hold != 1:
            raise ValueError(
                f"env must take an action for every sample, as plans do, but its hold is {experiment.hold}; "
                "make it with hold=1, or choose a learned policy or a signal"
            )
        whole = experiment.max_rms is not None and horizon is None
        if whole and (goal_std is not None or input_cost):
            raise ValueError(
                "goal_std and input_cost must be left out where the energy is limited, but are "
                f"{goal_std!r} and {input_cost!r}; pass a horizon to plan with them"
            )
        horizon = env.horizon if whole else horizon or _HORIZON
        self._energy = env.horizon * experiment.max_rms**2 if whole else None
        self._env = env
        self.seed = seed
        self.horizon, self.rounds, self.margin = int(horizon), int(rounds), float(margin)
        self._price = float(input_cost)
        self._goal = float(goal)
        self._goal_weight = 0.0 if goal_std is None else 0.5 / goal_std**2

    def predict(
        self,
        observation: npt.ArrayLike,
        state: PlannerState | None = None,
        episode_start: npt.ArrayLike | None = None,
        deterministic: bool = False,
    ) -> tuple[npt.NDArray[np.float32], PlannerState]:
        """Plan, and give the first input of each environment's plan.

        Args:
            observation: (n, features) what the environment showed last, or (features,) of a single one.
            state: what the last call returned; None begins new plans and streams.
            episode_start: (n,) which environments begin an episode, and so a new plan.
            deterministic: without effect: the search is reproducible by its seed.

        Returns:
            The actions in [-1, 1], float32 (n, 1), or (1,) for a single observation; and the next state.

        Raises:
            ValueError: if ``observation`` is not for as many environments as ``env`` has.
        """
        observed = np.asarray(observation, dtype=np.float64)
        records = self._env.records
        if observed.ndim not in (1, 2) or observed.size != len(records) * observed.shape[-1]:
            raise ValueError(
                f"observation must be of the planner's own {len(records)} environments, but has shape {observed.shape}"
            )
        n = len(records)
        if state is None:
            plans = np.zeros((n, self.horizon))
            words = np.array([_stream(child) for child in np.random.SeedSequence(self.seed).spawn(n)])
        else:
            plans, words = state[0].copy(), state[1].copy()
        if episode_start is not None:
            plans[np.broadcast_to(np.asarray(episode_start, dtype=np.bool_), n)] = 0.0
        time_left = observed.reshape(n, -1)[:, _TIME_LEFT]
        left = np.rint(time_left * self._env.horizon).astype(np.int64)
        experiment = self._env.experiment
        limits = float(experiment.max_input), float(experiment.max_output), self.margin
        inputs, scores = np.empty((2, n))
        if self._energy is not None:
            energies = observed.reshape(n, -1)[:, _BUDGET_LEFT] * self._energy
            pursue(records, left, energies, *limits, plans, words, inputs, scores)
        else:
            costs = self._price, self._goal, self._goal_weight
            plan(records, left, self.horizon, self.rounds, *limits, *costs, plans, words, inputs, scores)
        actions = (inputs / experiment.max_input).astype(np.float32)
        return actions.reshape(*observed.shape[:-1], 1), (plans, words)


def _stream(seed: np.random.SeedSequence) -> npt.NDArray[np.uint64]:
    """The four words of a fresh stream."""
    state: npt.NDArray[np.uint64] = np.random.SFC64(seed).state["state"]["state"]
    return state
