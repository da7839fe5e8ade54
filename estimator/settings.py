"""Options of an online estimator, and their checks."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

from estimator.inference.noise_grid import NoiseGridSize
from estimator.models.difference_equation import difference
from estimator.models.model import Model
from estimator.support.argument_checks import check_bool, check_choice, check_integer, check_number
from estimator.support.update_options import DEFAULT_ITERATIONS, EXPECTATIONS, MAX_ITERATIONS

#: Upper limit of the noise hypotheses in all.
_MAX_HYPOTHESES = 1000

#: Upper limit of the values of each noise in a grid of both.
_MAX_VALUES_PER_NOISE = 99


@dataclass(frozen=True)
class EstimatorSettings:
    """Options of a filter; `estimator.OnlineEstimator` explains each."""

    factorisation: str = "structured"
    iterations: int = 3
    as_published: bool = False
    expectations: str = "first_order"
    drift: float = 0.0
    noise_hypotheses: NoiseGridSize = 1


def checked_settings(model: Model, settings: EstimatorSettings) -> EstimatorSettings:
    """Check settings for a model, and convert their numbers.

    Raises:
        ValueError: naming the option, the value and the remedy.
    """
    check_choice("factorisation", settings.factorisation, DEFAULT_ITERATIONS)
    check_bool("as_published", settings.as_published)
    is_mean_field = settings.factorisation == "mean_field"
    if is_mean_field and model != difference():
        raise ValueError(
            f"factorisation must be 'structured' for {model.name}, but is 'mean_field'; that is for the paper's model"
        )
    check_integer("iterations", settings.iterations, MAX_ITERATIONS)
    if settings.as_published and not is_mean_field:
        raise ValueError(
            f"as_published goes with factorisation='mean_field', but factorisation is {settings.factorisation!r}; the "
            f"published run was mean field"
        )
    check_choice("expectations", settings.expectations, EXPECTATIONS[:1] if is_mean_field else EXPECTATIONS)
    check_number("drift", settings.drift, 0, 1, "0 is for a system that does not change")
    if settings.drift and is_mean_field:
        raise ValueError(
            f"drift must be 0 in mean field, which has no random walk, but is {settings.drift!r}; use structured"
        )
    return replace(
        settings,
        iterations=int(settings.iterations),
        as_published=bool(settings.as_published),
        drift=float(settings.drift),
        noise_hypotheses=checked_noise_hypotheses(settings.noise_hypotheses, settings.factorisation),
    )


def checked_noise_hypotheses(
    noise_hypotheses: object, factorisation: str, maximum: int = _MAX_HYPOTHESES
) -> NoiseGridSize:
    """Check one or two numbers of noise hypotheses for a factorisation; at most ``maximum`` in all.

    Raises:
        ValueError: naming the option, the value and the remedy.
    """
    if isinstance(noise_hypotheses, tuple | list) and len(noise_hypotheses) != 2:
        raise ValueError(f"noise_hypotheses must be a number, or two such as (5, 5), but is {noise_hypotheses!r:.60}")
    counts: list[Any] = list(noise_hypotheses) if isinstance(noise_hypotheses, tuple | list) else [noise_hypotheses]
    for count in counts:
        check_integer("noise_hypotheses", count, min(maximum, _MAX_VALUES_PER_NOISE) if len(counts) == 2 else maximum)
    if math.prod(counts) > maximum:
        raise ValueError(
            f"noise_hypotheses must be at most {maximum} in all, but are {noise_hypotheses}; (9, 9) are plenty"
        )
    if list(counts) != [1] and factorisation == "mean_field":
        raise ValueError(
            f"noise_hypotheses must be 1 for factorisation='mean_field', but is {noise_hypotheses}; use "
            f"factorisation='structured'"
        )
    return (int(counts[0]), int(counts[1])) if len(counts) == 2 else int(counts[0])
