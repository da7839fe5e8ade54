"""Abilities that take models with one input alone."""

from __future__ import annotations

from estimator.models.model import Model


def check_single_input(user: str, model: Model, remedy: str) -> str:
    """The name of the only input of a model.

    Args:
        user: what is made for one input alone, for the message.
        model: the equation.
        remedy: what to do instead.

    Raises:
        ValueError: for a model with several inputs or none.
    """
    if model.n_inputs != 1:
        raise ValueError(
            f"model must have one input for {user}, but {model.name!r} has {model.n_inputs}, {list(model.inputs)}; "
            f"{remedy}"
        )
    return next(iter(model.inputs))
