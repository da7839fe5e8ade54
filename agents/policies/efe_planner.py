"""Expected free energy planner: model-predictive control of the information about the coefficients.

It reads the belief and the model of its environment, and is no function of the observation. It rolls out the belief
under candidate inputs, and applies the first input of the best plan. The expected free energy of inputs u over the next
H samples is, in nats,

    G(u) = -[½ log det C_0 - ½ log det (C_H(u)⁻¹ + J)⁻¹]              information gain (epistemic)
           + Σ_h E[(x_h - goal)²] / (2 goal_std²)                       distance from a goal (pragmatic, optional)
           + input_cost Σ_h u_h²                                        cost of the input (optional)

with C_0 the covariance of the coefficients now and C_H their covariance after the H expected outputs, by belief
propagation: the joint posterior of state and coefficients is updated along the trajectory, so that the information of a
sample counts once. The information gain then telescopes: a plan of the whole episode would be Bayesian D-optimal. J is
the information that the rest of the episode brings anyway, at the rate of the last plans; so a plan seeks the
information that would be missing at the end. Plans that do not reach the end of the episode are compared by a mean of G
after each of their moves, with a discount (`agents.planning.discount`). Where the coefficients walk (``drift``) J is 0,
and the walk is rolled out as well.

The first sensor's output keeps a margin from the limit, in predictive standard deviations. The cost of an output within
the margin grows as the probability of an early end does, and beyond the limit it exceeds all information. On a rig the
margin is as hard as the limit. The margin is the quantile that Student's t exceeds with probability ``risk`` in an
episode whose outputs are all at the margin (`agents.planning.plan_objective.margin_profile`); it narrows as the noises
become known. Few outputs are at the margin, so violations are much rarer. The standard deviation is predicted two
samples before: near its limit a plan may brake as hard as it can already, and cannot react to one more output. Where
it could brake harder, most of the output's change by that is taken off the margin, down to the deviations predicted one
sample before (not on a rig). Where an input acts in full only a sample later, because it goes linearly from the last
one to the new, the noise of the sample between moves the next output about as much again, and no input corrects it: the
margin is then twice as wide.

Between two samples a rig's output exceeds the samples, and a plan with a hidden peak meets it later, when nothing
helps: on a rig the limit is lower by the part of a peak that samples can miss.

The search (`agents.planning.receding_horizon`) is a beam search on a grid of the model's first two states, refined by
Newton steps and mutations. Horizon 1 is myopic.

Where the input's energy is limited (``max_rms`` of the environment), the plan covers the whole rest of the episode, by
gradient (`agents.planning.energy_limited_plan`): timing then matters, which no short horizon sees. That search takes
neither ``max_slew`` nor ``drift`` into account.
"""

from __future__ import annotations

from copy import deepcopy
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from agents.planning.discount import discount_moves_for
from agents.planning.energy_limited_plan import compile_energy_limited_plan
from agents.planning.model_probe import ModelView, is_on_rig, observation_layout, planning_limit
from agents.planning.plan_objective import DEFAULT_RISK, PlanObjective, margin_profile
from agents.planning.receding_horizon import PlanArrays, PlanSettings, compile_receding_horizon
from agents.planning.time_scales import kept_accumulated_noise, probe_time_scales, recoverable_step
from agents.predict_argument_checks import check_batch_size, check_last_observation, episode_starts
from estimator.engine.noise_free_step import with_coarse_substeps
from estimator.models.single_input import check_single_input
from estimator.support.argument_checks import MIN_MAGNITUDE, check_integer, check_number, short_repr, to_float_array
from estimator.support.array_types import FloatArray


class EfePlannerState(NamedTuple):
    """The state of `EfePlanner.predict` for n environments.

    Attributes:
        plans: (n, horizon) the last plans [V].
        runner_ups: (n, horizon) the next best ones [V].
        information_rates: (n, K, K) information of plans per sample.
        rng_states: (n, 4) the streams of random numbers.
        last_inputs: (n,) the last inputs [V].
        chosen_inputs: (n,) the inputs chosen last [V].
        remaining_holds: (n,) samples for which these are still held.
        holds: (n,) samples of a move of the plans.
    """

    plans: FloatArray
    runner_ups: FloatArray
    information_rates: FloatArray
    rng_states: npt.NDArray[np.uint64]
    last_inputs: FloatArray
    chosen_inputs: FloatArray
    remaining_holds: npt.NDArray[np.int64]
    holds: npt.NDArray[np.int64]


#: Moves of a plan under an amplitude limit: some periods of the oscillator.
_DEFAULT_HORIZON = 44

#: Rounds of refinement of a plan, at most; three are usual.
_DEFAULT_ROUNDS = 12

#: Moves of an episode, at least: in a short episode moves are shorter.
_MIN_EPISODE_MOVES = 24

#: Moves of a plan, at most.
_MAX_MOVES = 100_000

#: Cells of the grid along an axis, per cube root of the moves in which the output rises to the limit: the smaller the
#: effect of a move, the finer the grid.
_CELLS_PER_CUBE_ROOT = 13.5

#: Cells of the grid along an axis, at least.
_MIN_CELLS = 22

#: Cells of the grid along an axis, at most.
_MAX_CELLS = 38


class EfePlanner:
    """Expected free energy planner on the belief and the model of an environment; no function of the observation.

    It plays the environment that it was made for, and no other. `predict` must be called between the steps of that
    environment, with its last observation, which is checked: a wrapper that changes or delays observations is refused.

    Environment i searches with its own stream of random numbers, the i-th child of the seed, so that its inputs do not
    depend on the size of the batch.

    Args:
        env: the unwrapped environment, single or vector, whose beliefs it reads.
        seed: of the search.
        horizon: moves of a plan, each held for at most ``objective.hold_samples`` samples, but no longer than the
            episode needs; by default 44, and the whole episode sample by sample where the energy is limited. No more
            than 24 in the last 48 moves of an episode.
        rounds: of refinement of each plan, at most, two blocks of `estimator.compilation.simd.LANES` candidates each; a
            round that gains less than 0.00005 nats is the last. Without effect on a plan of the whole episode.
        risk: probability that an episode ends early if every output were at the margin and the belief is right, in
            (0, 1).
        goal: mean of the goal prior of the first sensor's output, within its limit.
        goal_std: its standard deviation; None for no goal.
        input_cost: nats per squared input. Like the goal, it is in the belief's scale: in V on the tracks.

    Attributes:
        model_view: of the model in plans.
        objective: of plans, for the whole episode.

    Raises:
        ValueError: naming the argument, if there is no environment, it replays a record, has several inputs, holds its
            actions for several samples, a number is out of range, a goal has no ``goal_std``, a plan of the whole
            episode is asked to have a goal or cost, or where the energy of a long episode is limited and no horizon is
            given.
    """

    def __init__(
        self,
        env: Any,
        seed: int = 0,
        *,
        horizon: int | None = None,
        rounds: int = _DEFAULT_ROUNDS,
        risk: float = DEFAULT_RISK,
        goal: float = 0.0,
        goal_std: float | None = None,
        input_cost: float = 0.0,
    ) -> None:
        if not hasattr(env, "records") or hasattr(env, "recorded_input"):
            raise ValueError(
                f"env must be an environment of duffing_env that simulates a plant, but is {type(env).__name__}; "
                "the planner needs its beliefs: pass it to make_policy"
            )
        check_integer("horizon", _DEFAULT_HORIZON if horizon is None else horizon, _MAX_MOVES)
        check_integer("rounds", rounds, 1000)
        check_number("risk", risk, MIN_MAGNITUDE, 1 - MIN_MAGNITUDE)
        check_number("input_cost", input_cost, 0)
        experiment = env.experiment
        check_single_input("the planner", experiment.model, "choose a signal such as prbs")
        if experiment.hold != 1:
            raise ValueError(
                f"env must take an action for every sample, as plans do, but its hold is {experiment.hold}; "
                "make it with hold=1, or choose a signal or a feedback law"
            )
        if experiment.observation not in ("posterior", "privileged"):
            raise ValueError(
                f"env must show the posterior, in which the planner looks up the time left, but its observation is "
                f"{short_repr(experiment.observation)}; make it with observation='posterior'"
            )
        setup, self.model_view = experiment.kernel_params, ModelView.of(experiment)
        check_number("goal", goal, -float(setup.max_output), float(setup.max_output), "a goal lies within the limit")
        if goal_std is not None:
            check_number("goal_std", goal_std, remedy="None is no goal")
        elif goal:
            raise ValueError(f"goal_std must be given with a goal, but is None for goal={goal!r}; add goal_std=0.05")
        plans_whole_episode = bool(np.isfinite(setup.budget)) and horizon is None
        if plans_whole_episode and env.horizon > _MAX_MOVES:
            raise ValueError(
                f"horizon must be given in an episode of {env.horizon} samples whose energy is limited, but is None; a "
                f"plan of all of it has at most {_MAX_MOVES}"
            )
        if plans_whole_episode and (goal_std is not None or input_cost):
            raise ValueError(
                "goal_std and input_cost must be left out where the energy is limited, but are "
                f"{goal_std!r} and {input_cost!r}; pass a horizon to plan with them"
            )
        horizon = env.horizon if plans_whole_episode else min(horizon or _DEFAULT_HORIZON, env.horizon)
        self._energy = setup.budget if plans_whole_episode else None
        if plans_whole_episode:
            self._plan_rest_of_episode = compile_energy_limited_plan(
                with_coarse_substeps(self.model_view.model), self.model_view.degree
            ).plan_rest_of_episode
        self._env = env
        self.seed = seed
        self.horizon, self.rounds = int(horizon), int(rounds)
        means = experiment.prior_belief.coefficients_mean
        max_input = float(setup.max_input[0])
        time_scales = probe_time_scales(self.model_view, means, max_input, setup.max_output)
        self.objective = PlanObjective(
            amplitude=max_input,
            slew=float(setup.max_slew[0]),
            limit=planning_limit(experiment, time_scales.scales),
            margin=margin_profile(env.horizon, risk) * (1 + max(self.model_view.degree, self.model_view.lag)),
            walk=setup.walk_variances.copy(),
            scales=time_scales.scales,
            hold_samples=min(time_scales.hold_samples, -(-env.horizon // min(horizon, _MIN_EPISODE_MOVES))),
            accumulated_noise=kept_accumulated_noise(experiment, time_scales),
            input_weight=float(input_cost),
            goal=float(goal),
            goal_weight=0.0 if goal_std is None else 0.5 / goal_std**2,
            hard_margin=float(is_on_rig(experiment)),
            discount_moves=discount_moves_for(time_scales),
            recoverable_step=recoverable_step(experiment, self.model_view, time_scales),
            cells=int(
                np.clip(
                    _CELLS_PER_CUBE_ROOT * np.cbrt(time_scales.rise_time / time_scales.hold_samples),
                    _MIN_CELLS,
                    _MAX_CELLS,
                )
            ),
        )

    @property
    def settings(self) -> PlanSettings:
        """The settings of the search, for `agents.planning.open_loop.initial_guesses`."""
        return PlanSettings(self.model_view, self.objective, self.horizon, self.rounds)

    def predict(
        self,
        observation: npt.ArrayLike,
        state: EfePlannerState | None = None,
        episode_start: npt.ArrayLike | None = None,
        deterministic: bool = False,
    ) -> tuple[npt.NDArray[np.float32], EfePlannerState]:
        """Plan, and give the first input of each environment's plan, as `agents.policies.Policy`.

        An episode begins with a new plan, and where the state is None all plans and streams are new. ``deterministic``
        is without effect: the search is reproducible by its seed.

        Raises:
            ValueError: as `checked_rows`.
        """
        rows, episode_begins = self.checked_rows(observation, state, EfePlannerState, episode_start)
        records, objective = self._env.records, self.objective
        state = self._new_state(len(rows)) if state is None else deepcopy(state)
        older_inputs, remaining_holds = state.last_inputs, state.remaining_holds
        for part in (state.plans, state.runner_ups, state.information_rates, older_inputs, remaining_holds):
            part[episode_begins] = 0
        layout = observation_layout(self.model_view.model)
        samples_left = np.rint(rows[:, layout.time_left] * self._env.horizon).astype(np.int64)
        last_inputs = objective.amplitude * rows[:, layout.last_input]
        due = np.flatnonzero(remaining_holds == 0)
        arrays = PlanArrays(
            state.plans[due],
            state.runner_ups[due],
            state.information_rates[due],
            state.rng_states[due],
            np.empty(len(due)),
            state.holds[due],
        )
        if self._energy is not None:
            energies = rows[:, layout.budget_left] * self._energy
            self._plan_rest_of_episode(
                records, samples_left, energies, objective, last_inputs, arrays.plans, arrays.rng_states, arrays.actions
            )
        else:
            previous_inputs = np.stack([last_inputs, older_inputs], axis=1)[due]
            compile_receding_horizon(*self.model_view).plan(
                records[due], samples_left[due], self.horizon, self.rounds, objective, previous_inputs, arrays
            )
            remaining_holds[due] = arrays.holds
            remaining_holds -= 1
        for name in ("plans", "runner_ups", "information_rates", "rng_states", "holds"):
            getattr(state, name)[due] = getattr(arrays, name)
        state.chosen_inputs[due] = arrays.actions
        actions = (state.chosen_inputs / objective.amplitude).astype(np.float32)
        return actions.reshape(*np.shape(observation)[:-1], 1), state._replace(last_inputs=last_inputs)

    def _new_state(self, n: int) -> EfePlannerState:
        """The state of n environments before their first decision."""
        k = self.model_view.model.n_coefficients
        streams = map(np.random.SFC64, np.random.SeedSequence(self.seed).spawn(n))
        return EfePlannerState(
            plans=np.zeros((n, self.horizon)),
            runner_ups=np.zeros((n, self.horizon)),
            information_rates=np.zeros((n, k, k)),
            rng_states=np.array([stream.state["state"]["state"] for stream in streams]),
            last_inputs=np.zeros(n),
            chosen_inputs=np.zeros(n),
            remaining_holds=np.zeros(n, dtype=np.int64),
            holds=np.ones(n, dtype=np.int64),
        )

    def checked_rows(
        self,
        observation: npt.ArrayLike,
        state: Any,
        state_type: type[tuple[Any, ...]],
        episode_start: npt.ArrayLike | None,
    ) -> tuple[FloatArray, npt.NDArray[np.bool_]]:
        """The observations (n, features) of all environments, and which of them begin an episode (n,).

        Raises:
            ValueError: for an observation that is not finite, or not the last one of ``env``; or a state or
                ``episode_start`` for another batch.
        """
        observed, n = to_float_array("observation", observation), len(self._env.records)
        min_size = observation_layout(self.model_view.model).size
        if observed.ndim not in (1, 2) or observed.shape[-1] < min_size or observed.size != n * observed.shape[-1]:
            raise ValueError(
                f"observation must be of the {n} environments of this planner, with {min_size} entries each, but has "
                f"shape {observed.shape}; pass what they showed last"
            )
        if not np.isfinite(observed).all():
            raise ValueError("observation must be finite, but is not; pass what the environment showed last")
        if state is not None:
            if not isinstance(state, state_type):
                raise ValueError(f"state must be what the last call returned, or None, but is {short_repr(state)}")
            check_batch_size("state", len(state[0]), n)
        observed = observed.reshape(n, -1)
        check_last_observation(self._env, observed)
        return observed, episode_starts(episode_start, n)
