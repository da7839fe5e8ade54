"""The oracle: D-optimal inputs at the true parameters, stored, and the D-efficiency of other inputs against them.

`agents.evaluation.oracle_search` finds them. The worth of inputs has many summits, and the best one found is only a
lower bound of the highest. So whoever finds a better input puts it in its place.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path

import numpy as np
import numpy.typing as npt

from agents.evaluation.systems import Systems
from estimator.files import write_atomically
from estimator.parameters import FloatArray


@dataclass(frozen=True)
class Oracle:
    """The best inputs found so far.

    Attributes:
        systems: that they are for.
        inputs: (n, samples) [V].
        values: (n,) their worth [nats].
        bounds: (n,) what no admissible input is worth more than [nats] (`agents.evaluation.certificate`); NaN where
            nobody has found one.
    """

    systems: Systems
    inputs: FloatArray
    values: FloatArray
    bounds: FloatArray

    @classmethod
    def of(cls, systems: Systems) -> Oracle:
        """The stored oracle, of as many of the systems as it has.

        Raises:
            FileNotFoundError: if none is stored for them, saying which command makes one.
            ValueError: if it is for other systems.
        """
        path = systems.path
        if not path.is_file():
            command = "python -m agents.evaluation.oracle_search --env ..."
            raise FileNotFoundError(f"no oracle is stored for {systems.description}; run {command}")
        with np.load(path, allow_pickle=False) as stored:
            scaled, theta, bounds = stored["inputs"], stored["theta"], stored["bounds"]
        n = min(len(theta), len(systems.theta))
        if not np.allclose(theta[:n], systems.theta[:n], rtol=1e-9, atol=0):
            raise ValueError(f"oracle must be for the systems at hand, but {path.name} is not; make it anew")
        chosen = systems.rows(0, n)
        inputs = systems.limits.amplitude * (scaled[:n] / LEVELS)
        return cls(chosen, inputs, chosen.worth(inputs)[0], bounds[:n])

    @staticmethod
    def stored(systems: Systems) -> int:
        """The number of systems that an oracle is stored of."""
        if not systems.path.is_file():
            return 0
        with np.load(systems.path, allow_pickle=False) as stored:
            return len(stored["theta"])

    def first(self, count: int) -> Oracle:
        """That of the first systems."""
        return Oracle(self.systems.rows(0, count), self.inputs[:count], self.values[:count], self.bounds[:count])

    def save(self) -> Path:
        """Store it in the package, in one piece."""
        content = BytesIO()
        np.savez_compressed(
            content,
            inputs=_as_integers(self.inputs / self.systems.limits.amplitude),
            theta=self.systems.theta,
            values=self.values,
            bounds=self.bounds,
            task=np.array(json.dumps(self.systems.description)),
        )
        write_atomically(self.systems.path, content.getvalue())
        return self.systems.path

    def efficiency(self, inputs: npt.ArrayLike, outputs: npt.ArrayLike) -> tuple[FloatArray, FloatArray]:
        """D-efficiency of an episode: exp[(log det(Λ0+F) - log det(Λ0+F_oracle)) / K] for K coefficients.

        F is taken at the true coefficients along the outputs that were seen, because feedback keeps these within
        their limit, and not the response without noise to the same inputs, which drifts away from them. 0.5 means that
        about twice the samples would be needed. Above 1 says that there is a better input than the stored one, or that
        the noise was kind.

        Args:
            inputs: (n, samples) [V]; NaN from the end of an episode on.
            outputs: (n, samples) [V] that followed them; (n, samples, sensors) of several.

        Returns:
            (n,) against the stored inputs, and (n,) against the bounds: at least so much of what is possible.

        Raises:
            ValueError: for more rows than the oracle has systems, or as `estimator.fisher_information`.
        """
        u = np.asarray(inputs, dtype=np.float64)
        if u.ndim != 2 or len(u) > len(self.values):
            raise ValueError(f"inputs must have shape (n, samples) with n <= {len(self.values)}, but have {u.shape}")
        information = self.systems.information(u, outputs)
        values = 0.5 * np.linalg.slogdet(self.systems.precision + information)[1]
        best, least = (
            np.exp(2 * (values - top[: len(u)]) / information.shape[-1]) for top in (self.values, self.bounds)
        )
        return best, least


#: Inputs are stored as whole numbers, of which this one stands for the largest.
LEVELS = 32767


def as_stored(scaled: FloatArray) -> FloatArray:
    """Inputs in parts of the largest as they come back from the store, never larger than they were."""
    return _as_integers(scaled) / LEVELS


def _as_integers(scaled: FloatArray) -> npt.NDArray[np.int16]:
    # A little more, so that what was stored stays so.
    return np.trunc(scaled * (LEVELS * (1 + 1e-9))).astype(np.int16)
