"""The paper's model: a nonlinear latent autoregression with exogenous input, Eq. (2).

x_t = θ1 x_{t-1} + θ2 x_{t-1}³ + θ3 x_{t-2} + η u_{t-d},   y_t = x_t + v_t
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from estimator.gaussian import JointBelief
from estimator.lanes import kernel
from estimator.models.regressors import PRESETS, Term
from estimator.parameters import SILVERBOX_TWIN, FloatArray, to_coefficients


@dataclass(frozen=True)
class NLARX:
    """Model of the oscillator as a difference equation, linear in its coefficients.

    Attributes:
        nonlinear: whether the cubic term θ2 x³ is there; without it (θ2 = 0) the model is the paper's FEM-LARX.
        input_delay: samples d between an input and the output it acts on, where u and y are paired by array index.
            1 is what Eq. (2) derives; the published run used 0. Other regressors than the paper's have their own taps.
        regressors: ``paper``, or another preset of `estimator.models.regressors.PRESETS` (``offset``, ``three-tap``,
            ``cubic``), or the terms themselves. Anything but ``paper`` is for the structured factorisation; its
            belief is a `JointBelief`, with the coefficients by name.

    Raises:
        ValueError: if ``input_delay`` is neither 0 nor 1, a preset is unknown, or there are no terms.
    """

    nonlinear: bool = True
    input_delay: int = 1
    regressors: str | tuple[Term, ...] = "paper"

    needs_all_inputs: ClassVar[bool] = False

    def __post_init__(self) -> None:
        if self.input_delay not in (0, 1):
            raise ValueError(f"input_delay must be 0 or 1, but is {self.input_delay!r}; Eq. (2) has 1")
        if isinstance(self.regressors, str):
            if self.regressors not in PRESETS:
                raise ValueError(f"regressors must be one of {list(PRESETS)} or terms, but is {self.regressors!r}")
        elif not self.regressors or len(set(self.regressors)) < len(self.regressors):
            raise ValueError(f"regressors must be different terms, at least one, but is {self.regressors!r}")
        if not self.is_paper and not self.nonlinear:
            raise ValueError("nonlinear must be True for regressors of one's own; leave the powers out of the terms")

    @property
    def is_paper(self) -> bool:
        """Whether the regressors are those of Eq. (2), for which both factorisations are compiled across lanes."""
        return self.regressors == "paper"

    @property
    def terms(self) -> tuple[Term, ...]:
        """The regressors."""
        return PRESETS[self.regressors] if isinstance(self.regressors, str) else self.regressors

    def prior(
        self,
        spread: float = 0.3,
        process_noise: float = 5e-6,
        measurement_noise: float = 1e-3,
        noise_shape: float = 2.0,
    ) -> JointBelief:
        """A weak prior for regressors of one's own, about the Silverbox twin.

        Args:
            spread: standard deviation of the coefficients of lags and inputs; those of products have 1 + spread,
                those of offsets a tenth of it (in volts).
            process_noise: standard deviation [V] at which γ is centred.
            measurement_noise: standard deviation [V] at which ξ is centred.
            noise_shape: shape of both Gamma priors.

        The coefficients that Eq. (2) has are centred on the twin's, the others on 0.
        """
        twin = to_coefficients(SILVERBOX_TWIN)
        centers = dict(zip(PRESETS["paper"], (twin.theta1, twin.theta2, twin.theta3, twin.eta), strict=True))
        degrees = [term.lag1 + term.lag2 + (term.tap is not None) for term in self.terms]
        std = [0.1 * spread if degree == 0 else spread if degree == 1 else 1 + spread for degree in degrees]
        mean = np.array([0.0, 0.0, *(centers.get(term, 0.0) for term in self.terms)])
        cov = np.diag(np.array([0.1, 0.1, *std]) ** 2)
        names, units = tuple(term.name for term in self.terms), tuple(term.unit for term in self.terms)
        noises = (noise_shape, noise_shape * process_noise**2, noise_shape, noise_shape * measurement_noise**2)
        return JointBelief(names, units, mean, cov, *noises)

    def delayed(self, u: FloatArray) -> FloatArray:
        """The inputs (T,) that act on the outputs of the same index; before the first sample the input was 0."""
        return u if self.input_delay == 0 else np.concatenate(([0.0], u[:-1]))

    def predict(self, coefficients: FloatArray, u: FloatArray, y: FloatArray) -> FloatArray:
        """One-step predictions (T,) of y from its last two values; the first two entries repeat y."""
        t1, t2, t3, e = coefficients
        predicted = y.copy()
        predicted[2:] = t1 * y[1:-1] + t2 * y[1:-1] ** 3 + t3 * y[:-2] + e * self.delayed(u)[2:]
        return predicted

    def simulate(self, coefficients: FloatArray, u: FloatArray, y_init: FloatArray) -> FloatArray:
        """Free run (T,) over u, started by the given first outputs; inf or NaN from where it diverges."""
        x = np.empty(len(u))
        x[: len(y_init)] = y_init
        _simulate(coefficients, self.delayed(u), x, len(y_init))
        return x


@kernel
def _simulate(coefficients, u, x, start):
    """Continue the recursion in place from sample ``start`` on."""
    t1, t2, t3, e = coefficients[0], coefficients[1], coefficients[2], coefficients[3]
    for t in range(start, len(x)):
        last = x[t - 1]
        x[t] = t1 * last + t2 * last * last * last + t3 * x[t - 2] + e * u[t]
