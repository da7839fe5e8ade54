"""A start of the oracle's search for a known system: the best path through the grid of its states over an episode."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import numpy as np

from agents.planning.belief_rollout import compile_belief_rollout
from agents.planning.d_optimality import factorise_information
from agents.planning.grid_beam_search import SearchProblem, compile_grid_beam_search
from agents.planning.plan_refinement import compile_plan_refinement
from estimator.compilation.simd import LANES, kernel
from estimator.models.model import Model


@cache
def compile_beam_start(model: Model, degree: int = 0) -> Callable[..., None]:
    """``beam_start(record, first, cells, objective, information_rate, rng_state, u)``, compiled for a model.

    It fills in the inputs u (T,) from sample ``first`` on, for a system at the means of the belief, with a grid of
    ``cells`` along each axis. ``information_rate`` (K, K) is the expected information per sample in the rest of the
    episode. The record is overwritten.

    Args:
        model: the equation.
        degree: degree of the input's polynomial over a sample.
    """
    size, k = compile_belief_rollout(model, degree).size, model.n_coefficients
    workspace, find_best_plan = compile_grid_beam_search(model, degree)
    advance_record = compile_plan_refinement(model, degree).advance_record

    @kernel(variant=f"{model.name}_{model.digest}_{degree}")
    def beam_start(record, first, cells, objective, information_rate, rng_state, u):
        information_factor, W, previous_inputs = np.zeros((k, k)), np.empty(size), np.zeros(2)
        factorise_information(information_rate, information_factor)
        for t in range(first):
            advance_record(W, record, u[t], previous_inputs, objective)
        samples_left = len(u) - first
        beam_width = -(-cells * cells // LANES) * LANES
        problem = SearchProblem(
            record,
            samples_left,
            samples_left,
            1,
            objective,
            previous_inputs,
            information_factor,
            cells,
            0,
            samples_left,
            beam_width,
            beam_width,
            np.nan,
            1.0,
        )
        find_best_plan(workspace(samples_left, beam_width), problem, u[first:], rng_state)

    return beam_start
