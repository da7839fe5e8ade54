"""The experiment of Kouw (2020), section 4, repeated on the Silverbox record and set against the published numbers.

Every model is trained on the multisine part of the record (90,972 samples, in one pass for the online ones) and
validated on the arrow part (40,100 samples) with its parameters fixed: by one-step predictions from the measured
outputs, and by a free run, the simulation, from the first two of them. `reproduce` does it all; ``docs/reproduction.md``
discusses the outcome.
"""

from __future__ import annotations

import io
import json as json_format
import platform
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from importlib.metadata import version
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.progress import Progress, SpinnerColumn, TimeElapsedColumn
from rich.table import Table

from agents.policies import make_policy
from duffing_env.env import DuffingEnv
from duffing_env.silverbox import Regime, load_record
from estimator import NLARX, OnlineEstimator, Prior
from estimator.offline import PEMNARX
from estimator.parameters import FloatArray

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PUBLISHED = {
    "PEM-NARX": {"prediction_mse": 5.830793034083989e-05, "simulation_mse": 1.001367833873263e-03},
    "FEM-LARX": {"prediction_mse": 5.9446129987526364e-05, "simulation_mse": 1.0204335589997665e-03},
    "FEM-NLARX": {"prediction_mse": 5.8304968780121563e-05, "simulation_mse": 9.256401174690808e-04},
}
"""Mean squared errors [V²] of the published run, from its own code and files; its text has 1.002e-3 for FEM-LARX."""

VERSIONED = ("duffing-env", "gymnasium", "matplotlib", "numba", "numpy", "scipy")
"""Distributions whose versions are written beside the results."""

EVERY = 80
"""Of so many samples the figures show one, as the paper's do."""


@dataclass(frozen=True)
class Setting:
    """One way to run the experiment. All of them start from `Prior.published_run`.

    Attributes:
        summary: what a reader of the table is told.
        factorisation: of the online estimator, ``mean_field`` or ``structured``.
        input_delay: samples between an input and the output it acts on, 0 or 1.
        as_published: keep the published run's two departures from the derived messages.
        through_environment: the samples pass through the Gymnasium environment, one step each.
        with_baseline: fit the offline baseline, PEM-NARX, with this input delay too.
    """

    summary: str
    factorisation: str = "mean_field"
    input_delay: int = 0
    as_published: bool = False
    through_environment: bool = False
    with_baseline: bool = False

    @property
    def models(self) -> list[str]:
        """Names of the models that are run, in the paper's order."""
        return [model for model in PUBLISHED if model != "PEM-NARX" or self.with_baseline]


SETTINGS = {
    "as_published": Setting(
        "mean field, input delay 0, the published run's two departures", as_published=True, with_baseline=True
    ),
    "through_environment": Setting(
        "the same, but every sample is a step of SilverboxReplay-v0", as_published=True, through_environment=True
    ),
    "corrected_messages": Setting("mean field, input delay 0, messages as derived"),
    "as_derived": Setting("mean field, input delay 1 as in Eq. (2), messages as derived", "mean_field", 1)
    | {"with_baseline": True},
    "structured": Setting("states and coefficients jointly Gaussian, input delay 1", "structured", 1),
}
