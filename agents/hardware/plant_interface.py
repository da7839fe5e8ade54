"""The hardware interface of a rig: the methods that a run calls to apply inputs and read outputs."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol

import numpy.typing as npt

from agents.user_code import load_object
from estimator.rigs.rig import Rig
from estimator.support.array_types import FloatArray

#: The value of a rig's only input, or (inputs,) values of several.
InputValue = float | FloatArray


class HardwarePlant(Protocol):
    """A plant, in the rig's units. It begins disarmed, with its input at zero; any exception ends the run.

    A method that is never called need not work: a run by samples calls no `play`, a run by blocks neither `apply` nor
    `read`.

    Attributes:
        has_watchdog: whether the plant zeroes its input by itself after the silence [s] that `arm` was given.
    """

    has_watchdog: bool

    def arm(self, watchdog: float | None) -> object:
        """Let inputs through from now on; a plant with a watchdog zeroes its input after ``watchdog`` s of silence."""

    def apply(self, u: Any) -> Any:
        """Apply an input from now until the next one; returns the input after the plant's own clamps.

        It is a float; of a rig with several inputs an array (inputs,), which is applied at once.
        """
        ...

    def read(self) -> float:
        """The output now. Where there is no new value, raise or return NaN: never return an old value."""
        ...

    def play(self, u: FloatArray) -> tuple[npt.ArrayLike, npt.ArrayLike]:
        """Play inputs (N,), one per sampling step, then zero.

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
    """Make a plant by ``factory(rig, **settings)``, where ``factory_path`` is ``module:factory``.

    Modules in the working directory are found, too.

    Args:
        factory_path: such as ``lab:plant``.
        rig: passed to the factory.
        settings: the table ``[instrument]`` of the rig file.

    Raises:
        ValueError: for a module or factory that does not exist, a factory that fails, or a result that is no plant.
        ModuleNotFoundError: for a package that the factory needs and that is not installed.
    """
    factory = load_object(factory_path, "plant")
    try:
        plant = factory(rig, **(settings or {}))
    except ModuleNotFoundError:
        raise
    except (Exception, SystemExit) as error:
        raise ValueError(
            f"plant must be made by {factory_path}(rig, **instrument), with the table [instrument] of the rig file, "
            f"but that failed: {type(error).__name__}: {error}"
        ) from error
    return check_plant(plant)


def check_plant(plant: Any) -> HardwarePlant:
    """The plant, if it has all attributes of `HardwarePlant`.

    Raises:
        ValueError: naming the attributes that are missing.
    """
    required = [*_PLANT_METHODS, "has_watchdog"]
    missing = [name for name in required if not hasattr(plant, name)]
    if missing:
        raise ValueError(f"plant must have {required}, but {plant!r:.60} has no {missing}; add them")
    checked: HardwarePlant = plant
    return checked
