"""Planning of the whole rest of an episode under a limit of the input's energy, by gradient, compiled for any model.

With little energy, timing matters: the best input is zero first, and then drives the oscillator in one resonant burst,
which no short horizon finds. So a plan covers all samples left, and ascends the D-optimality
(`agents.planning.d_optimality`) of the response from the belief: its means count as the truth, its covariance is Λ⁻¹,
and the state's part of the covariance gives the initial sensitivities and the filter's initial covariance. The Kalman
filter separates state and parameters, so this is the belief propagation of `agents.planning.receding_horizon`.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

import numpy as np

from agents.planning.d_optimality import NominalSystem, compile_d_optimality, half_log_det, invert_from_cholesky
from agents.planning.plan_mutations import next_uniform
from agents.planning.plan_objective import MAX_MARGIN_FRACTION, objective_at
from agents.planning.projected_gradient import DesignLimits, compile_projected_gradient, project_input
from estimator.belief import covariance_indices
from estimator.compilation.array_operations import copy
from estimator.compilation.simd import jit_closure, kernel
from estimator.engine.storage_layout import belief_rows
from estimator.models.model import Model

#: Input before and after a burst, in parts of the input within it.
_OFF_BURST_FRACTION = 0.2

#: Gradient steps of the plan.
_N_STEPS = 8

#: Gradient steps of a challenger before it is compared.
_N_TRIAL_STEPS = 3

#: Length of the first step in parts of the radius that the energy allows.
_STEP_FRACTION = 0.2

#: Multiple of the limit beyond which a burst restarts the system at rest.
_RESTART_RATIO = 2.0

#: Halvings of a plan that leads beyond the limit, at most.
_MAX_HALVINGS = 6


class EnergyLimitedPlan(NamedTuple):
    """Compiled functions of one model and interpolation of the input.

    Attributes:
        plan_rest_of_episode: ``plan_rest_of_episode(records, samples_left, energies, objective, previous_input, plans,
            rng_state, actions)`` improves the plans of n environments by some gradient steps:

            - ``records`` (n, size): their beliefs, as `estimator.Belief` keeps them;
            - ``samples_left`` (n,) and ``energies`` (n,): samples and energy left in their episodes;
            - ``objective``: `agents.planning.plan_objective.PlanObjective` of the whole episode; its margin counts the
              predictive deviations of the first sample;
            - ``previous_input`` (n,): the inputs that were applied last;
            - ``plans`` (n, T): the last plans, begun one sample ago; zeros before the first; overwritten;
            - ``rng_state`` (n, 4): streams of random numbers; overwritten;
            - ``actions`` (n,): receives the first input of each plan.
        start_from_belief: ``start_from_belief(record, precision, start)`` fills in the inverse (K, K) of the
            coefficients' covariance, and the rows of a path's start (`agents.planning.d_optimality`) without its older
            inputs.
        resonant_bursts: ``resonant_bursts(nominal, limit, energy, inputs, rng_state)`` fills inputs (k, T) with bursts
            from rest, which push along the motion.
    """

    plan_rest_of_episode: Callable[..., None]
    start_from_belief: Callable[..., None]
    resonant_bursts: Callable[..., None]


def _compile_key(model: Model, degree: int) -> str:
    return f"{model.name}_{model.digest}_{degree}"


@cache
def _compile_start(model: Model, degree: int) -> Any:
    """``start_from_belief``, as `EnergyLimitedPlan`."""
    n, k, covariance = model.n_states, model.n_coefficients, covariance_indices(model)
    sensitivity_start = n + n * (n + 1) // 2

    @jit_closure(_compile_key(model, degree))
    def start_from_belief(record, precision, start):
        work = np.empty((k, k))
        for a in range(k):
            for b in range(k):
                work[a, b] = record[covariance[n + a, n + b]]
        half_log_det(work)
        invert_from_cholesky(work, precision)
        copy(start, 0, record, n)
        # State = Z (error of the coefficients) + an independent remainder, with Z = P_xc Λ.
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

    return start_from_belief


@cache
def _compile_bursts(model: Model, degree: int) -> tuple[Any, Any]:
    """``free_response`` and ``resonant_burst``."""
    d_optimality, compile_inner = compile_d_optimality(model, degree), jit_closure(_compile_key(model, degree))
    path, start_size, n_path = d_optimality.path_functions, d_optimality.start_size, d_optimality.n_path
    begin_path, coefficients_of, lay, step = path.begin, path.coefficients, path.input_coefficients, path.step

    @compile_inner
    def free_response(nominal, start, previous_input, tape):
        """The signals of two samples without input, and the first one's predictive variance."""
        C = coefficients_of(nominal.coefficients)
        P, F = begin_path(start)
        P, F, x, output_variance = step(P, F, C, lay(0.0, previous_input, 0.0), nominal.noises, tape, 0)
        _, _, next_output, _ = step(P, F, C, lay(0.0, 0.0, previous_input), nominal.noises, tape, 0)
        return x, next_output, output_variance

    @compile_inner
    def resonant_burst(nominal, start, limit, energy, is_first_plan, u, rng_state, tape):
        """Fill u (T,) with a burst along the motion of the signal from a random sample on, weak before and after it.

        The first plan of an episode is not random, and late: the belief is then better.
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

    return free_response, resonant_burst


@cache
def _compile_improvement(model: Model, degree: int) -> tuple[Any, Any]:
    """``shift_by_one_sample`` and ``improve_plan``."""
    d_optimality, compile_inner = compile_d_optimality(model, degree), jit_closure(_compile_key(model, degree))
    criterion, ascend = d_optimality.criterion, compile_projected_gradient(model, degree).ascend
    _, resonant_burst = _compile_bursts(model, degree)

    @compile_inner
    def shift_by_one_sample(plan):
        """Drop the first input of a plan (T,); return whether the plan was all zeros, that is new."""
        T, is_new = len(plan), plan[0] == 0.0
        for t in range(T - 1):
            is_new = is_new and plan[t + 1] == 0.0
            plan[t] = plan[t + 1]
        plan[T - 1] = 0.0
        return is_new

    @compile_inner
    def improve_plan(nominal, limits, limit, start, is_new, u, burst, best, rng_state, workspace):
        """Ascend from the plan u and from a burst, and keep the better one within ``limit``."""
        n_samples, soft_limit = len(u), limits.soft_limit
        project_input(u, limits.amplitude, limits.energy)
        resonant_burst(nominal, start, limit, limits.energy, is_new, burst, rng_state, workspace.tape)
        project_input(burst, limits.amplitude, limits.energy)
        score = ascend(nominal, limits, _STEP_FRACTION, _N_STEPS, start, u, best, workspace)
        if is_new or ascend(nominal, limits, _STEP_FRACTION, _N_TRIAL_STEPS, start, burst, best, workspace) > score:
            copy(u, 0, burst, n_samples)
            ascend(nominal, limits, _STEP_FRACTION, _N_STEPS, start, u, best, workspace)
        # The ascent may not have come back from beyond the limit.
        for _ in range(_MAX_HALVINGS):
            _, peak = criterion(nominal, soft_limit, 0.0, start, u, workspace)
            if peak <= limit:
                break
            for t in range(n_samples):
                u[t] *= 0.5

    return shift_by_one_sample, improve_plan


@cache
def compile_energy_limited_plan(model: Model, degree: int = 0) -> EnergyLimitedPlan:
    """Compile for a model; arguments as `agents.planning.d_optimality.compile_d_optimality`."""
    d_optimality, start_from_belief = compile_d_optimality(model, degree), _compile_start(model, degree)
    workspace_for, start_size, n_path = d_optimality.workspace, d_optimality.start_size, d_optimality.n_path
    free_response, resonant_burst = _compile_bursts(model, degree)
    shift_by_one_sample, improve_plan = _compile_improvement(model, degree)
    n, k, sensors = model.n_states, model.n_coefficients, model.n_outputs
    as_noises, noise = d_optimality.path_functions.noises, belief_rows(model).index("GAMMA_SHAPE")
    compile_entry = kernel(variant=_compile_key(model, degree))

    @compile_entry
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
            limits = DesignLimits(np.inf, soft_limit, objective.amplitude, energies[i])
            is_new = shift_by_one_sample(plans[i])
            u, burst = plans[i, :n_samples], challenger[:n_samples]
            improve_plan(
                nominal, limits, objective.limit, start, is_new, u, burst, best[:n_samples], rng_state[i], workspace
            )
            actions[i] = u[0]

    @compile_entry
    def resonant_bursts(nominal, limit, energy, inputs, rng_state):
        tape, start = workspace_for(1).tape, np.zeros(start_size)
        for i in range(len(inputs)):
            resonant_burst(nominal, start, limit, energy, False, inputs[i], rng_state, tape)

    return EnergyLimitedPlan(plan_rest_of_episode, start_from_belief, resonant_bursts)
