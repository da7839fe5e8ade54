"""How an online estimator learns: its options, checked."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

from estimator.ensemble import Hypotheses
from estimator.inference import DEFAULT_ITERATIONS, EXPECTATIONS, MOST_ITERATIONS
from estimator.models.difference_equation import difference
from estimator.models.model import Model
from estimator.support.argument_checks import check_bool, check_choice, check_integer, check_number

#: More ratios of the noises than data could tell apart; and of two numbers, more values of each than there are noises.
_MOST_HYPOTHESES, _MOST_VALUES = 1000, 99


@dataclass(frozen=True)
class Settings:
    """How a filter learns: `estimator.OnlineEstimator` says what each option means."""

    factorisation: str = "structured"
    iterations: int = 3
    as_published: bool = False
    expectations: str = "first_order"
    drift: float = 0.0
    noise_hypotheses: Hypotheses = 1


def settled(model: Model, given: Settings) -> Settings:
    """Settings that fit a model, checked.

    Raises:
        ValueError: naming the option, the value and the remedy.
    """
    check_choice("factorisation", given.factorisation, DEFAULT_ITERATIONS)
    check_bool("as_published", given.as_published)
    published = given.factorisation == "mean_field"
    if published and model != difference():
        raise ValueError(
            f"factorisation must be 'structured' for {model.name}, but is 'mean_field'; that is for the paper's model"
        )
    check_integer("iterations", given.iterations, MOST_ITERATIONS)
    if given.as_published and not published:
        raise ValueError(
            f"as_published goes with factorisation='mean_field', but factorisation is {given.factorisation!r}; the "
            f"published run was mean field"
        )
    check_choice("expectations", given.expectations, EXPECTATIONS[:1] if published else EXPECTATIONS)
    check_number("drift", given.drift, 0, 1, "0 is a system that stays, and of one that walks faster nothing is known")
    if given.drift and published:
        raise ValueError(f"drift must be 0 in mean field, which cannot follow, but is {given.drift!r}; use structured")
    return replace(
        given,
        iterations=int(given.iterations),
        as_published=bool(given.as_published),
        drift=float(given.drift),
        noise_hypotheses=checked_hypotheses(given.noise_hypotheses, given.factorisation, model),
    )


def checked_hypotheses(given: object, factorisation: str, model: Model, most: int = _MOST_HYPOTHESES) -> Hypotheses:
    """A number of noise hypotheses, or two, that fit factorisation and model, and are at most ``most``.

    Raises:
        ValueError: naming the option, the value and the remedy.
    """
    if isinstance(given, tuple | list) and len(given) != 2:
        raise ValueError(f"noise_hypotheses must be a number, or two such as (5, 5), but is {given!r:.60}")
    counts: list[Any] = list(given) if isinstance(given, tuple | list) else [given]
    for count in counts:
        check_integer("noise_hypotheses", count, min(most, _MOST_VALUES) if len(counts) == 2 else most)
    if math.prod(counts) > most:
        raise ValueError(f"noise_hypotheses must be at most {most} in all, but are {given}; (9, 9) are plenty")
    published = factorisation == "mean_field"
    if list(counts) != [1] and (published or model.n_outputs > 1):
        what = "factorisation='mean_field'" if published else f"{model.name}, which has several sensors"
        remedy = "use factorisation='structured'" if published else "centre the priors of its noises with care"
        raise ValueError(f"noise_hypotheses must be 1 for {what}, but is {given}; {remedy}")
    return (int(counts[0]), int(counts[1])) if len(counts) == 2 else int(counts[0])
