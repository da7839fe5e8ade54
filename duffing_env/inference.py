"""The belief update within an environment's block: structured for any model, or the paper's mean field."""

from __future__ import annotations

from typing import Any

from duffing_env.layout import Kind, layout_of
from estimator.engine.tasks import structured
from estimator.inference import mean_field


def updater(kind: Kind) -> Any:
    """Update every lane's belief, with its input and outputs in their rows.

    ``update(W)``, or of mean field ``update(W, iterations, as_published)``.
    """
    if kind.factorisation == "mean_field":
        return mean_field.updater(layout_of(kind))
    return structured(
        kind.belief, kind.degree, iterations=kind.iterations, within=layout_of(kind), trace=kind.work == "free_energy"
    ).update
