"""The planner's search under a limit of energy, compiled for any model: the whole rest of the episode, by gradient.

When energy is short, what matters is when to spend it: the best input rests, and then drives the oscillator up at its
own frequency in one burst. No short horizon sees that. So the plan is for all samples that are left, and climbs the
worth (`agents.planning.d_optimality`) of what follows from the belief: its means as the truth, its covariance as Λ⁻¹, and the
state's part in that as the sensitivities and the filter's covariance to start with. By the Kalman filter's separation
of state and parameters this is the same belief propagation as that of `agents.planning.receding_horizon`.
"""

from __future__ import annotations

from functools import cache
from typing import Any, NamedTuple

import numpy as np

from agents.planning.candidate_inputs import next_uniform
from agents.planning.d_optimality import NominalSystem, compile_d_optimality, half_log_det, invert_from_cholesky
from agents.planning.plan_objective import MAX_MARGIN_FRACTION, objective_at
from agents.planning.projected_gradient import DesignLimits, compile_projected_gradient, project_input
from estimator.belief import covariance_indices
from estimator.compilation.array_operations import copy
from estimator.compilation.simd import jit_closure, kernel
from estimator.engine.storage_layout import belief_rows
from estimator.models.model import Model

#: Input before and after a burst, in parts of that within.
_OFF_BURST_FRACTION = 0.2

#: Steps of the gradient for the plan, and for a challenger before it is compared.
_N_STEPS, _N_TRIAL_STEPS = 8, 3

#: Length of these steps in parts of what the energy allows.
_STEP_FRACTION = 0.2

#: A burst that drives the signal further than so many times its limit goes on from rest.
_RESTART_RATIO = 2.0

#: A plan that leads beyond the limit is halved up to so many times.
_MAX_HALVINGS = 6


class EnergyLimitedPlan(NamedTuple):
    """Compiled functions of one model and interpolation of the input.

    Attributes:
        plan_rest_of_episode: ``plan_rest_of_episode(records, left, energies, objective, last, plans, rng_state, actions)``: improve the plans of n
            environments by some gradient steps.

            - ``records`` (n, size): their beliefs, as `estimator.Belief` keeps them.
            - ``left`` (n,) samples, and ``energies`` (n,) energy, left in their episodes.
            - ``objective``: `agents.planning.plan_objective.PlanObjective` of the whole episode; the margin is of the first sample's
              predictive deviations.
            - ``last`` (n,): the inputs applied last.
            - ``plans`` (n, T): the last plans, begun one sample ago; all zeros where there is none. Overwritten.
            - ``rng_state`` (n, 4): streams of random numbers; overwritten.
            - ``actions`` (n,) receives the first input of each plan.
        start_from_belief: ``start_from_belief(record, precision, start)``: of a belief the inverse (K, K) of the coefficients' covariance, and
            the rows of a path's start (`agents.planning.d_optimality`); the older inputs in it are left as they are.
        resonant_bursts: ``resonant_bursts(nominal, limit, energy, inputs, rng_state)``: fill inputs (k, T) with bursts from rest, which push as
            the system moves.
    """

    plan_rest_of_episode: Any
    start_from_belief: Any
    resonant_bursts: Any


@cache
def compile_energy_limited_plan(model: Model, degree: int = 0) -> EnergyLimitedPlan:
    """Planning the whole rest of an episode of a model; arguments as `agents.planning.d_optimality.compile_d_optimality`."""
    d_optimality, ascend = compile_d_optimality(model, degree), compile_projected_gradient(model, degree).ascend
    criterion, workspace_for, start_size, n_path = (
        d_optimality.criterion,
        d_optimality.workspace,
        d_optimality.start_size,
        d_optimality.n_path,
    )
    begin_path, coefficients_of, lay, step = (
        d_optimality.path_functions.begin,
        d_optimality.path_functions.coefficients,
        d_optimality.path_functions.input_coefficients,
        d_optimality.path_functions.step,
    )
    n, k, sensors = model.n_states, model.n_coefficients, model.n_outputs
    compile_key = f"{model.name}_{model.digest}_{degree}"
    sensitivity_start = n + n * (n + 1) // 2  # of the sensitivities in a start
    as_noises, covariance, noise = (
        d_optimality.path_functions.noises,
        covariance_indices(model),
        belief_rows(model).index("GAMMA_SHAPE"),
    )

    @jit_closure(compile_key)
    def start_from_belief(record, precision, start):
        work = np.empty((k, k))
        for a in range(k):
            for b in range(k):
                work[a, b] = record[covariance[n + a, n + b]]
        half_log_det(work)
        invert_from_cholesky(work, precision)
        copy(start, 0, record, n)
        # State = Z (coefficients' error) + what is left of it, with Z = P_xc Λ.
        for a in range(n):
            for b in range(k):
                total = 0.0
                for c in range(k):
                    total += record[covariance[a, n + c]] * precision[c, b]
                start[sensitivity_start + k * a + b] = total
        place = n
        for a in range(n):
            for b in range(a, n):
                value = record[covariance[a, b]]
                for c in range(k):
                    value -= start[sensitivity_start + k * a + c] * record[covariance[b, n + c]]
                start[place] = max(0.0, value) if a == b else value
                place += 1

    @jit_closure(compile_key)
    def free_response(nominal, start, previous_input, tape):
        """The signals of two samples without input, and the first one's predictive variance."""
        C = coefficients_of(nominal.coefficients)
        P, F = begin_path(start)
        P, F, x, output_variance = step(P, F, C, lay(0.0, previous_input, 0.0), nominal.noises, tape, 0)
        _, _, next_output, _ = step(P, F, C, lay(0.0, 0.0, previous_input), nominal.noises, tape, 0)
        return x, next_output, output_variance

    @jit_closure(compile_key)
    def resonant_burst(nominal, start, limit, energy, is_first_plan, u, rng_state, tape):
        """A burst (T,) that pushes as the signal moves, from a random sample on; weak before and after it.

        ``is_first_plan`` is the first plan of an episode: not random, and late enough that the burst finds a better belief.
        """
        T = len(u)
        burst_start = int(T * (0.35 if is_first_plan else 0.6 * next_uniform(rng_state)))
        burst_length = 1 + int(T * (0.4 if is_first_plan else 0.2 + 0.6 * next_uniform(rng_state)))
        strength = np.sqrt(energy / burst_length)
        previous_input = start[n_path] if start_size > n_path else 0.0
        before, x, _ = free_response(nominal, start, previous_input, tape)
        older_input = 0.0
        C = coefficients_of(nominal.coefficients)
        P, F = begin_path(start)
        for t in range(T):
            in_burst = burst_start <= t < burst_start + burst_length
            u[t] = (strength if in_burst else _OFF_BURST_FRACTION * strength) * (1.0 if x >= before else -1.0)
            before = x
            P, F, x, _ = step(P, F, C, lay(u[t], previous_input, older_input), nominal.noises, tape, 0)
            previous_input, older_input = u[t], previous_input
            if not abs(x) < _RESTART_RATIO * limit:
                P, F = begin_path(np.zeros(start_size))
                x = 0.0

    @kernel(variant=compile_key)
    def plan_rest_of_episode(records, samples_left, energies, objective, previous_input, plans, rng_state, actions):
        T = plans.shape[1]
        start, precision, coefficients = np.zeros(start_size), np.empty((k, k)), np.empty(k)
        variances, workspace, challenger, best = np.empty(sensors + 1), workspace_for(T), np.empty(T), np.empty(T)
        for i in range(len(records)):
            n_samples = max(1, min(T, samples_left[i]))
            start_from_belief(records[i], precision, start)
            if start_size > n_path:
                start[n_path] = previous_input[i]
            copy(coefficients, 0, records[i, n:], k)
            for a in range(sensors + 1):
                variances[a] = records[i, noise + 2 * a + 1] / records[i, noise + 2 * a]
            nominal = NominalSystem(coefficients, precision, as_noises(variances))
            _, _, output_variance = free_response(nominal, start, previous_input[i], workspace.tape)
            margin = objective_at(objective, samples_left[i]).margin * np.sqrt(
                output_variance + objective.accumulated_noise * variances[0]
            )
            soft_limit = objective.limit - min(margin, MAX_MARGIN_FRACTION * objective.limit)
            u, burst = plans[i, :n_samples], challenger[:n_samples]
            is_new = plans[i, 0] == 0.0
            for t in range(T - 1):
                is_new = is_new and plans[i, t + 1] == 0.0
                plans[i, t] = plans[i, t + 1]
            plans[i, T - 1] = 0.0
            limits = DesignLimits(np.inf, soft_limit, objective.amplitude, energies[i])
            project_input(u, objective.amplitude, energies[i])
            resonant_burst(nominal, start, objective.limit, energies[i], is_new, burst, rng_state[i], workspace.tape)
            project_input(burst, objective.amplitude, energies[i])
            score = ascend(nominal, limits, _STEP_FRACTION, _N_STEPS, start, u, best[:n_samples], workspace)
            if (
                is_new
                or ascend(nominal, limits, _STEP_FRACTION, _N_TRIAL_STEPS, start, burst, best[:n_samples], workspace)
                > score
            ):
                copy(u, 0, burst, n_samples)
                ascend(nominal, limits, _STEP_FRACTION, _N_STEPS, start, u, best[:n_samples], workspace)
            # The gradient may not have come down from where it began.
            for _ in range(_MAX_HALVINGS):
                _, peak = criterion(nominal, soft_limit, 0.0, start, u, workspace)
                if peak <= objective.limit:
                    break
                for t in range(n_samples):
                    u[t] *= 0.5
            actions[i] = u[0]

    @kernel(variant=compile_key)
    def resonant_bursts(nominal, limit, energy, inputs, rng_state):
        tape, start = workspace_for(1).tape, np.zeros(start_size)
        for i in range(len(inputs)):
            resonant_burst(nominal, start, limit, energy, False, inputs[i], rng_state, tape)

    return EnergyLimitedPlan(plan_rest_of_episode, start_from_belief, resonant_bursts)
