"""Models: what the next output is, given the last ones, the input and the coefficients. One file a model."""

from __future__ import annotations

from collections.abc import Callable

from estimator.models.difference_equation import difference
from estimator.models.duffing import duffing
from estimator.models.model import Model
from estimator.models.pendulum import PENDULUM, PENDULUM_EULER
from estimator.models.wiener_hammerstein import WIENER_HAMMERSTEIN

#: Name of a model to what makes it.
MODELS: dict[str, Callable[[], Model]] = {
    "difference": difference,
    "duffing": duffing,
    "pendulum": lambda: PENDULUM,
    "pendulum_map": lambda: PENDULUM_EULER,
    "wiener_hammerstein": lambda: WIENER_HAMMERSTEIN,
}
