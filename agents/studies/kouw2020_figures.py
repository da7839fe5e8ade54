"""The two figures of errors in Kouw (2020)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from duffing_env.silverbox import Regime

if TYPE_CHECKING:
    from matplotlib.figure import Figure

EVERY = 80
"""The figures show one sample of this many, as the paper's do."""


def draw(runs: Mapping[str, Any], validation: Regime, measure: str) -> Figure:
    """One of the paper's two figures of errors: a column for each model, the lower row in log scale.

    Args:
        runs: The models by name.
        validation: What they were validated on.
        measure: ``prediction`` or ``simulation``.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 5.2), dpi=100, layout="constrained")
    axes = figure.subplots(2, len(runs), sharex=True, sharey="row", squeeze=False)
    samples = np.arange(0, len(validation.y), EVERY)
    for (upper, lower), (model, run) in zip(axes.T, runs.items(), strict=True):
        output = getattr(run, measure)[samples]
        squared_error = (output - validation.y[samples]) ** 2
        upper.plot(samples, output, color="purple", linewidth=0.8, label=f"{measure} [V]")
        upper.plot(samples, squared_error, color="black", linewidth=1.0, label="squared error [V²]")
        upper.set_title(f"{model}: MSE {getattr(run, f'{measure}_mse'):.3e} V²", fontsize=11)
        lower.semilogy(samples, squared_error, color="black", linewidth=0.6, nonpositive="mask")
        lower.set_xlabel("sample")
    axes[0, 0].set_ylabel("output [V], squared error [V²]")
    axes[1, 0].set_ylabel("squared error [V²]")
    axes[0, 0].legend(loc="lower left", fontsize=9)
    return figure
