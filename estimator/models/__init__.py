"""Models of plants: differential and difference equations with unknown coefficients, one file each."""

from __future__ import annotations

from collections.abc import Callable

from estimator.models.difference_equation import difference
from estimator.models.duffing import duffing
from estimator.models.model import Model
from estimator.models.pendulum import PENDULUM, PENDULUM_EULER
from estimator.models.wiener_hammerstein import WIENER_HAMMERSTEIN

#: Name of a model to a function that makes it.
MODELS: dict[str, Callable[[], Model]] = {
    "difference": difference,
    "duffing": duffing,
    "pendulum": lambda: PENDULUM,
    "pendulum_map": lambda: PENDULUM_EULER,
    "wiener_hammerstein": lambda: WIENER_HAMMERSTEIN,
}
