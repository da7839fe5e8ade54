"""Ratios between the independent process noises of a model's states."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from estimator.models.model import Model
from estimator.support.argument_checks import check_mapping, check_number


def scale_noise_sources(model: Model, ratios: Mapping[str, float]) -> Model:
    """A model with the process noise of some states scaled.

    Args:
        model: with independent noise.
        ratios: state to the positive factor on its standard deviation; the others keep theirs.

    Raises:
        ValueError: for a model whose states share one source, a state without noise, or a factor out of range.
    """
    check_mapping("ratios", ratios)
    unknown = sorted(set(ratios).difference(model.noise_sources))
    if unknown:
        raise ValueError(
            f"ratios must be of states with independent noise, {list(model.noise_sources)}, but have {unknown}; "
            "declare the model with independent_noise=True"
        )
    for state, ratio in ratios.items():
        check_number(f"ratios of {state}", ratio, 1e-30, 1e30)
    pairs = zip(model.states, model.noise, strict=True)
    noise = tuple(f"{float(ratios[state])!r}*({text})" if state in ratios else text for state, text in pairs)
    return replace(model, noise=noise)
