"""Rows of a noise-free rollout that features are read from (`agents.policies.networks.rollout_features`)."""

from __future__ import annotations

from functools import cache
from itertools import combinations
from typing import NamedTuple

from agents.planning.model_probe import ModelView, observation_layout, only_input_rows
from estimator.engine.noise_free_step import compile_noise_free_step


class RolloutRows(NamedTuple):
    """Rows and sizes of a rollout (`estimator.engine.noise_free_step`), and of its observation.

    Attributes:
        size: numbers of a rollout.
        n: states.
        k: coefficients.
        u: row of the input; last: of the input before; older: of the one before that.
        now: row of the first sensor's output; velocity: of its velocity; signal: of its output after a sample.
        phi: row of the derivatives of that output by the coefficients.
        velocity_state: index of the state whose sign a push follows; -1 for the output's velocity.
        pairs: of coefficients, in the order of the observation's correlations.
        odd: entries of the observation that change sign with the motion.
    """

    size: int
    n: int
    k: int
    u: int
    last: int
    older: int
    now: int
    velocity: int
    signal: int
    phi: int
    velocity_state: int
    pairs: tuple[tuple[int, int], ...]
    odd: tuple[int, ...]


@cache
def rollout_rows(view: ModelView) -> RolloutRows:
    """The rows of a model's rollout."""
    model, layout = view.model, observation_layout(view.model)
    row = compile_noise_free_step(*view).layout
    # A push along the motion itself pumps: along the rise of an accelerometer's output it would brake.
    rate, states, sensor = (model.rates or ("",))[0], list(model.states), next(iter(model.outputs.values()))
    velocity_state = states.index(rate) if rate in states and sensor != states[0] else -1
    newest, last, older = only_input_rows(model)
    return RolloutRows(
        size=len(row),
        n=model.n_states,
        k=model.n_coefficients,
        u=row[newest],
        last=row[last],
        older=row[older],
        now=row["NOW"],
        velocity=row["VELOCITY"] if velocity_state < 0 else row[rate],
        signal=row["Y_PRED"],
        phi=row[f"PHI_{next(iter(model.coefficients))}"],
        velocity_state=velocity_state,
        pairs=tuple(combinations(range(model.n_coefficients), 2)),
        odd=(
            *range(layout.state, layout.state + model.n_states),
            layout.last_input,
            *range(layout.last_output, layout.last_output + model.n_outputs),
        ),
    )
