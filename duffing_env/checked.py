"""Checks of beliefs and parameters among an experiment's options."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from estimator.belief import Belief
from estimator.checks import LARGEST, SMALLEST, number, shown
from estimator.models.model import Model
from estimator.units import Scales


def check_mean(given: Mapping[str, float] | None, names: Sequence[str]) -> None:
    """Refuse middles of the parameters' ranges that are not such, of some or all of them."""
    if given is None:
        return
    if not isinstance(given, Mapping) or not set(given) <= set(names):
        raise ValueError(f"mean must give some of the parameters {list(names)}, but is {shown(given)}")
    for name, value in given.items():
        number(f"mean[{name!r}]", value, SMALLEST if name == "m" else -LARGEST)


def check_prior(prior: Belief | None, scales: Scales, model: Model | None = None) -> None:
    """Refuse what is not a belief, or one in other scales, or of another model where that is given."""
    if not isinstance(prior, Belief):
        raise ValueError(f"prior must be an estimator.Belief or None, but is {shown(prior)}")
    if prior.scales != scales:
        raise ValueError(f"prior must have the scales {scales}, but has {prior.scales}; give it those")
    if model is not None and prior.model != model:
        raise ValueError(f"prior must be of the model {model.name!r}, but is of {prior.model.name!r}")
