"""Times one model of `benchmarks.compile_time` in one version of this project, in a process of its own.

It runs in that version's tree. Versions before 1249e8a had other names for the record likelihood.
"""

import json
import sys
import time
from typing import Any

import numpy as np

from estimator.models.model import Model

#: Samples of the record: a few, since the first call is what is timed.
SAMPLES = 16


def chain_of_masses(masses: int) -> Model:
    """A chain between a wall and a free end, with 2 states and 4 coefficients per mass.

    Each mass has a spring to the mass before it, and a damper and a cubic and a quadratic spring to the ground. The
    first has the gain of the input in place of the quadratic spring. The sensor measures the last mass.
    """
    rates: list[str] = []
    for i in range(masses):
        left = f"x{i} - x{i - 1}" if i else "x0"
        force = f"-k{i}*({left}) - c{i}*(x{i})**3 - d{i}*v{i}"
        if i + 1 < masses:
            force += f" + k{i + 1}*(x{i + 1} - x{i})"
        force += f" + g{i}*u" if i == 0 else f" - g{i}*x{i}**2"
        rates += [f"v{i}", force]
    numbers = range(masses)
    return Model(
        name=f"chain{masses}",
        states={name: "1" for i in numbers for name in (f"x{i}", f"v{i}")},
        coefficients={f"{letter}{i}": "1" for i in numbers for letter in "kcdg"},
        noise=tuple(effect for _ in numbers for effect in ("0", "1")),
        outputs={"y": f"x{masses - 1}"},
        rates=tuple(rates),
        substeps=4,
    )


def likelihood(model: Model) -> float:
    """Minus the log likelihood of a record, computed with its gradient and information."""
    sampled: Any
    likelihoods: Any
    try:
        from estimator.inference.record_filter import inputs_by_sample as sampled
        from estimator.inference.record_filter import record_likelihoods as likelihoods
    except ImportError:  # the names of an older version
        from estimator.information import follow as likelihoods  # type: ignore[import-not-found,no-redef]
        from estimator.information import sampled  # type: ignore[no-redef]

    rng = np.random.default_rng(0)
    u, y = rng.standard_normal((1, SAMPLES)), 0.01 * rng.standard_normal((1, SAMPLES, 1))
    points = np.full((1, model.n_coefficients), 0.1)
    noises = np.array([[1e-4, 1e-4]])
    found = likelihoods(model, points, sampled(model, u), y, noises, 1e-2 * np.eye(model.n_states))
    return float(found.loss[0])


if __name__ == "__main__":
    model = chain_of_masses(int(sys.argv[1]) // 2)
    started = time.process_time()
    loss = likelihood(model)
    print(json.dumps({"seconds": time.process_time() - started, "loss": loss}))
