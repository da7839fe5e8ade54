"""Checks of what is known of a plant before an episode: the middle of its parameters' ranges, and a prior."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict

from estimator.belief import Belief
from estimator.models.model import Model
from estimator.rigs.units import Scales
from estimator.support.argument_checks import MAX_MAGNITUDE, MIN_MAGNITUDE, check_number, short_repr


def check_nominal_parameters(means: Mapping[str, float] | None, names: Sequence[str]) -> None:
    """Refuse unknown parameters, and values that cannot be the middle of a parameter's range.

    Raises:
        ValueError: with the parameter and its value.
    """
    if means is None:
        return
    if not isinstance(means, Mapping) or not set(means) <= set(names):
        raise ValueError(f"mean must give some of the parameters {list(names)}, but is {short_repr(means)}")
    for name, value in means.items():
        check_number(f"mean[{name!r}]", value, MIN_MAGNITUDE if name == "m" else -MAX_MAGNITUDE)


def check_prior(prior: Belief | None, scales: Scales, model: Model | None = None) -> None:
    """Refuse a prior that is no belief, has other scales, or is of another model than ``model``, if that is given.

    Raises:
        ValueError: with the differences and the remedy.
    """
    if not isinstance(prior, Belief):
        raise ValueError(f"prior must be an estimator.Belief or None, but is {short_repr(prior)}")
    if prior.scales != scales:
        scale_words = {"input": "limit", "output": "range", "order": "order of the output's derivative"}
        differences = [
            (scale_words.get(name, name.replace("_", " ")), getattr(prior.scales, name), required)
            for name, required in asdict(scales).items()
            if required != getattr(prior.scales, name)
        ]
        found = " and ".join(f"{name} {value!r}" for name, value, _ in differences)
        wanted = " and ".join(f"{name} {value!r}" for name, _, value in differences)
        raise ValueError(
            f"prior must have the scales of the rig, but was saved with {found}, and the rig says {wanted}; identify "
            f"once more with the present rig and save that, or change the rig back"
        )
    if model is not None and prior.model != model:
        raise ValueError(f"prior must be of the model {model.name!r}, but is of {prior.model.name!r}")
