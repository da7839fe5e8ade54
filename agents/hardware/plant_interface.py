"""The plant of a run: what is between a rig and the program. Any object with these methods."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol

import numpy.typing as npt

from agents.user_code import load_object
from estimator.rigs.rig import Rig
from estimator.support.array_types import FloatArray


class HardwarePlant(Protocol):
    """A plant, in the rig's units. It begins disarmed, its input at zero; any exception ends the run.

    A method that is never called need not work: a plant for runs by samples needs no `play`, one for runs by blocks
    neither `apply` nor `read`.

    Attributes:
        has_watchdog: whether it zeroes its input by itself when it has heard nothing for the time that `arm` was told.
    """

    has_watchdog: bool

    def arm(self, watchdog: float | None) -> object:
        """Let inputs through from now on; zero by itself after ``watchdog`` seconds of silence, if it watches."""

    def apply(self, u: float) -> float:
        """Apply an input now, until the next; returns what is applied in truth, after clamps of the plant's own."""
        ...

    def read(self) -> float:
        """The output now. A value that is not new is an exception, or NaN: never an old value without a word."""
        ...

    def play(self, u: FloatArray) -> tuple[npt.ArrayLike, npt.ArrayLike]:
        """Play inputs (N,), one a sampling step, then zero.

        Returns:
            Inputs (N,) as they were applied, and outputs (N,): the k-th at the moment when the k-th input began.
        """
        ...

    def zero(self) -> object:
        """Bring the input to zero now."""

    def disarm(self) -> object:
        """Let no input through any more."""


_PLANT_METHODS = ("arm", "apply", "read", "play", "zero", "disarm")


def load_plant(factory_path: str, rig: Rig, settings: Mapping[str, Any] | None = None) -> HardwarePlant:
    """The plant that ``factory(rig, **settings)`` makes, where ``factory_path`` is ``module:factory``.

    A module in the working directory is found, too.

    Args:
        factory_path: such as ``lab:plant``.
        rig: handed to the factory.
        settings: the table ``[instrument]`` of the rig file.

    Raises:
        ValueError: naming what is wrong: no such module or factory, one that fails, or no plant.
        ModuleNotFoundError: for a package that the factory needs, and that is not there.
    """
    factory = load_object(factory_path, "plant")
    try:
        plant = factory(rig, **(settings or {}))
    except ModuleNotFoundError:
        raise
    except (Exception, SystemExit) as error:
        raise ValueError(
            f"plant must be made by {factory_path}(rig, **instrument), with the table [instrument] of the rig file, but that "
            f"failed: {type(error).__name__}: {error}"
        ) from error
    return check_plant(plant)


def check_plant(plant: Any) -> HardwarePlant:
    """The plant, if it is one.

    Raises:
        ValueError: naming the methods that are missing.
    """
    missing = [name for name in (*_PLANT_METHODS, "watches") if not hasattr(plant, name)]
    if missing:
        raise ValueError(
            f"plant must have {[*_PLANT_METHODS, 'watches']}, but {plant!r:.60} has no {missing}; add them"
        )
    checked: HardwarePlant = plant
    return checked
