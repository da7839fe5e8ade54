"""The rig: how a model stands in the world of the samples."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from estimator.parameters import SAMPLING_STEP

#: How the input goes between samples, and the degree of the polynomial that each takes.
INTERPOLATIONS = {"zero_order": 0, "linear": 1, "look_ahead": 5, "spline": 5}


@dataclass(frozen=True)
class Rig:
    """Sampling step, and how recorded inputs act between samples. u and y are paired by index.

    Attributes:
        step: sampling step [s].
        interpolation: of the input of a differential equation; a difference equation has taps instead. ``zero_order``:
            u[k] acts from sample k to k + 1, and is first seen in y[k+1]. ``linear``: from u[k-1] to u[k]. Both are
            causal, and the input before the first was 0. ``look_ahead``: the quintic spline through the last nine
            inputs and the next one, so that a sample is used when the next input is known. ``spline``: the quintic
            spline through all inputs, for recorded data that is given at once. Before their first input it was the
            same.
        delay: samples by which the input acts later than that, 0 or 1. A difference equation's newest tap acts on y[k]
            with u[k - delay]: 1 for the paper's in recorded data. -1 is for ``zero_order`` alone, where pairs are those
            of an environment: u[k] acted before y[k].

    Raises:
        ValueError: naming the argument, for a value out of its range.

    Example:
        >>> from estimator.rig import Rig
        >>> Rig(step=1e-3, interpolation="zero_order").delay
        0
    """

    step: float = SAMPLING_STEP
    interpolation: str = "linear"
    delay: int = 0

    def __post_init__(self) -> None:
        if not isinstance(self.step, int | float) or not 0 < self.step < np.inf:
            raise ValueError(
                f"step must be positive and finite, but is {self.step!r}; give the seconds between samples"
            )
        if self.interpolation not in INTERPOLATIONS:
            raise ValueError(f"interpolation must be one of {list(INTERPOLATIONS)}, but is {self.interpolation!r}")
        allowed = (-1, 0, 1) if self.interpolation == "zero_order" else (0, 1)
        if isinstance(self.delay, bool) or self.delay not in allowed:
            raise ValueError(
                f"delay must be one of {allowed} for interpolation={self.interpolation!r}, but is {self.delay!r}; "
                f"shift u by the rest"
            )

    @classmethod
    def silverbox(cls, interpolation: str = "linear", delay: int = 0) -> Rig:
        """The Silverbox record's: 610.35 Hz, a band-limited input."""
        return cls(SAMPLING_STEP, interpolation, delay)
