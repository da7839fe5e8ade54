"""The physical equation itself as the model: Eq. (1), integrated over each sample.

    x'' = g (u - u0) - c x' - k x - b x³ - e x'³,        y = x + y0 + d u + v

The measured input is band-limited, so it must not be held between samples: it is interpolated by a polynomial
per sample, whose coefficients say how much of the future is used. The integration is the classical Runge-Kutta
method of order 4 with exact sensitivities: the derivative of its arithmetic, not finite differences.

Inside, time is counted in samples (δ = 1), so that all parameters are of the order of one, and the offsets are counted
as the output shows them: with z = x + y0 and the constant force f = k y0 - g u0,

    z'' = g u + f - c z' - k z - b (z - y0)³ - e z'³,        y = z + d u + v.

Outputs tell z and f at once, but u0 and y0 only together. A filter that linearises in x, u0 and y0 takes the changes of
its own k and g for news that tells them apart, and its intervals become far too narrow.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from estimator.gaussian import JointBelief
from estimator.inference import joint, sigma_points
from estimator.lanes import inlined, jit, kernel
from estimator.parameters import SAMPLING_STEP, SILVERBOX_TWIN, FloatArray

#: Parameters with their units, in the order of the joint state after (x, x').
PARAMETERS = {
    "stiffness": "s⁻²",
    "damping": "s⁻¹",
    "gain": "s⁻²",
    "cubic": "V⁻² s⁻²",
    "input_offset": "V",
    "cubic_damping": "V⁻² s",
    "output_offset": "V",
    "feedthrough": "1",
}
N_STATES = 2
N_JOINT = N_STATES + len(PARAMETERS)

#: What the motion depends on: the state, and all parameters but the feedthrough.
N_MOTION = N_JOINT - 1

#: Length of a row of sigma points.
_ROW = 2 * N_MOTION

#: Direction of the process noise in (z, z'): an acceleration held over a sample, scaled to move z by 1.
NOISE_DIRECTION = np.array([1.0, 2.0])

#: Factors from units per sample to physical ones, of (x, x', parameters).
_SCALES = SAMPLING_STEP ** np.array([0.0, -1.0, -2.0, -1.0, -2.0, -2.0, 0.0, 1.0, 0.0, 0.0])

#: Places of u0, whose coordinate is f, and of y0.
_FORCE, _OFFSET = 6, 8

#: Of the spline through the inputs: the input has power up to two thirds of the Nyquist frequency.
SPLINE_DEGREE = 5

INTERPOLATIONS = ("linear", "look_ahead", "spline")


@dataclass(frozen=True)
class DuffingODE:
    """Model of the oscillator as an ordinary differential equation.

    Attributes:
        interpolation: of the input between samples. ``linear``: causal. ``look_ahead``: the cubic through the two
            samples before and the two after, so that a sample is used when the next input is known. ``spline``: the
            quintic spline through all inputs, for recorded data that is given at once.
        cubic_damping: whether the damping has the cubic term e x'³; without it e = 0.
        substeps: Runge-Kutta steps per sample. On the Silverbox 2 simulate as well, but shift the stiffness by more
            than its standard deviation, because the posterior becomes that narrow.

    Raises:
        ValueError: for an unknown interpolation, or substeps below 1.
    """

    interpolation: str = "linear"
    cubic_damping: bool = False
    substeps: int = 8

    names: ClassVar[tuple[str, ...]] = tuple(PARAMETERS)
    units: ClassVar[tuple[str, ...]] = tuple(PARAMETERS.values())

    def __post_init__(self) -> None:
        if self.interpolation not in INTERPOLATIONS:
            raise ValueError(f"interpolation must be one of {list(INTERPOLATIONS)}, but is {self.interpolation!r}")
        if not isinstance(self.substeps, int) or self.substeps < 1:
            raise ValueError(f"substeps must be a whole number of at least 1, but is {self.substeps!r}")

    @property
    def look_ahead(self) -> int:
        """Inputs after a sample that must be known before it is used."""
        return 1 if self.interpolation == "look_ahead" else 0

    @property
    def needs_all_inputs(self) -> bool:
        """Whether no sample can be used before all inputs are known."""
        return self.interpolation == "spline"

    def prior(
        self,
        spread: float = 0.3,
        process_noise: float = 5e-6,
        measurement_noise: float = 1e-3,
        noise_shape: float = 2.0,
    ) -> JointBelief:
        """A weak prior about the Silverbox twin.

        Args:
            spread: relative standard deviation of stiffness, damping, gain and cubic stiffness.
            process_noise: what the process noise of a sample does to x: standard deviation [V] at which γ is centred.
            measurement_noise: standard deviation [V] at which ξ is centred.
            noise_shape: shape of both Gamma priors.

        The offsets are 0 with a standard deviation of 20 mV, the feedthrough 0 with one of 0.1, the cubic damping 0
        with one of 0.1 per sample; the oscillator is at rest to within 0.1 V.
        """
        twin = SILVERBOX_TWIN
        main = np.array([twin.a / twin.m, twin.c / twin.m, 1 / twin.m, twin.b / twin.m])
        mean = np.concatenate([[0.0, 0.0], main, [0.0, 0.0, 0.0, 0.0]])
        std = np.concatenate(
            [[0.1, 0.1 / SAMPLING_STEP], spread * main, [0.02, 0.1 * SAMPLING_STEP, 0.02, 0.1]]
        )  # fmt: skip
        noises = (noise_shape, noise_shape * process_noise**2, noise_shape, noise_shape * measurement_noise**2)
        return JointBelief(self.names, self.units, mean, np.diag(std**2), *noises)

    def pieces(self, u: FloatArray) -> FloatArray:
        """The input between samples as polynomials of τ in [0, 1]: (T - 1, degree + 1) coefficients of 1, τ, τ², ..."""
        start, stop = u[:-1], u[1:]
        if self.interpolation == "linear":
            return np.column_stack([start, stop - start])
        if self.interpolation == "look_ahead":
            before = np.concatenate([u[:1], u[:-2]])
            after = np.concatenate([u[2:], u[-1:]])
            return np.column_stack(
                [
                    start,
                    stop - start / 2 - before / 3 - after / 6,
                    (before + stop) / 2 - start,
                    (start - stop) / 2 + (after - before) / 6,
                ]
            )
        return _spline_pieces(u)


def to_coordinates(mean: FloatArray, cov: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Mean and covariance of (x, x', parameters) in physical units, as those of (z, z', ..., f, ...) per sample.

    To first order, and the inverse of `from_coordinates`.

    Raises:
        ValueError: if u0 is known where f is not: f would be tied to k, g and y0 by a line, but the truth is not.
    """
    mean, cov = mean / _SCALES, cov / np.outer(_SCALES, _SCALES)
    k, g, u0, y0 = mean[[2, 4, _FORCE, _OFFSET]]
    offset_is_known = cov[_FORCE, _FORCE] == 0
    slopes = np.eye(N_JOINT)
    slopes[0, _OFFSET] = 1.0
    slopes[_FORCE, [2, 4, _FORCE, _OFFSET]] = y0, -u0, -g, k
    mean[0] += y0
    mean[_FORCE] = k * y0 - g * u0
    cov = slopes @ cov @ slopes.T
    if offset_is_known and cov[_FORCE, _FORCE] > 0:
        raise ValueError(
            f"prior must leave input_offset free, but fixes it at {u0}; subtract it from u, and fix both offsets at 0"
        )
    return mean, cov


def from_coordinates(mean: FloatArray, cov: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Mean and covariance of (z, z', ..., f, ...) per sample, as those of (x, x', parameters) in physical units."""
    k, g, f, y0 = mean[[2, 4, _FORCE, _OFFSET]]
    u0 = (k * y0 - f) / g
    slopes = np.eye(N_JOINT)
    slopes[0, _OFFSET] = -1.0
    slopes[_FORCE, [2, 4, _FORCE, _OFFSET]] = y0 / g, -u0 / g, -1 / g, k / g
    mean = mean.copy()
    mean[0] -= y0
    mean[_FORCE] = u0
    return mean * _SCALES, slopes @ cov @ slopes.T * np.outer(_SCALES, _SCALES)


def _spline_pieces(u: FloatArray) -> FloatArray:
    """(T - 1, 6) coefficients of the quintic spline through all inputs."""
    from scipy.interpolate import make_interp_spline

    if len(u) <= SPLINE_DEGREE:
        raise ValueError(f"u must have more than {SPLINE_DEGREE} samples for interpolation 'spline', but has {len(u)}")
    spline = make_interp_spline(np.arange(len(u)), u, k=SPLINE_DEGREE)
    starts = np.arange(len(u) - 1)
    return np.column_stack([spline(starts, nu=n) / math.factorial(n) for n in range(SPLINE_DEGREE + 1)])


@inlined
def _acceleration(z, v, u, k, c, g, b, f, e, y0):
    x = z - y0
    return g * u + f - c * v - k * z - b * x * x * x - e * v * v * v


@jit
def _derivative(z, v, p, u, J, D):
    """(z', z'') at a point, and into ``D`` the derivative of the sensitivities ``J`` (2, N_MOTION)."""
    k, c, g, b, f, e, y0 = p[0], p[1], p[2], p[3], p[4], p[5], p[6]
    x = z - y0
    slope_z = -k - 3.0 * b * x * x
    slope_v = -c - 3.0 * e * v * v
    for j in range(N_MOTION):
        D[0, j] = J[1, j]
        D[1, j] = slope_z * J[0, j] + slope_v * J[1, j]
    D[1, 2] -= z
    D[1, 3] -= v
    D[1, 4] += u
    D[1, 5] -= x * x * x
    D[1, 6] += 1.0
    D[1, 7] -= v * v * v
    D[1, 8] += 3.0 * b * x * x
    return v, _acceleration(z, v, u, k, c, g, b, f, e, y0)


@jit
def flow(z, v, p, piece, substeps, J, work):
    """Move (z, z') over one sample.

    Args:
        z: displacement plus output offset [V].
        v: its change per sample [V].
        p: (7,) parameters of the motion k, c, g, b, f, e, y0, per sample.
        piece: (degree + 1,) the input's polynomial.
        substeps: Runge-Kutta steps.
        J: (2, N_MOTION) receives the sensitivities of the result to z, v and p.
        work: (3, 2, N_MOTION) memory.
    """
    D, trial, total = work[0], work[1], work[2]
    J[:] = 0.0
    J[0, 0] = J[1, 1] = 1.0
    h = 1.0 / substeps
    for s in range(substeps):
        u0 = _polynomial(piece, s * h)
        u1 = _polynomial(piece, (s + 0.5) * h)
        u2 = _polynomial(piece, (s + 1.0) * h)
        z1, v1 = _derivative(z, v, p, u0, J, D)
        for i in range(2):
            for j in range(N_MOTION):
                total[i, j] = D[i, j]
                trial[i, j] = J[i, j] + 0.5 * h * D[i, j]
        z2, v2 = _derivative(z + 0.5 * h * z1, v + 0.5 * h * v1, p, u1, trial, D)
        for i in range(2):
            for j in range(N_MOTION):
                total[i, j] += 2.0 * D[i, j]
                trial[i, j] = J[i, j] + 0.5 * h * D[i, j]
        z3, v3 = _derivative(z + 0.5 * h * z2, v + 0.5 * h * v2, p, u1, trial, D)
        for i in range(2):
            for j in range(N_MOTION):
                total[i, j] += 2.0 * D[i, j]
                trial[i, j] = J[i, j] + h * D[i, j]
        z4, v4 = _derivative(z + h * z3, v + h * v3, p, u2, trial, D)
        for i in range(2):
            for j in range(N_MOTION):
                J[i, j] += h / 6.0 * (total[i, j] + D[i, j])
        z += h / 6.0 * (z1 + 2.0 * z2 + 2.0 * z3 + z4)
        v += h / 6.0 * (v1 + 2.0 * v2 + 2.0 * v3 + v4)
    return z, v


@jit
def flow_points(points, count, piece, substeps):
    """Move (z, z') over one sample at many points at once, as `flow` does, without sensitivities.

    Args:
        points: (N_MOTION, 2 N_MOTION), a point in each of its first ``count`` columns: z, v and the parameters as
            `flow` has them; the first two rows are overwritten.
        count: number of points.
        piece: (degree + 1,) the input's polynomial.
        substeps: Runge-Kutta steps.
    """
    W = points.reshape(-1)  # with rows of constant length, for the compiler to take several points at once
    h = 1.0 / substeps
    for s in range(substeps):
        u0 = _polynomial(piece, s * h)
        u1 = _polynomial(piece, (s + 0.5) * h)
        u2 = _polynomial(piece, (s + 1.0) * h)
        for i in range(count):
            z, v = W[i], W[_ROW + i]
            k, c, g, b = W[2 * _ROW + i], W[3 * _ROW + i], W[4 * _ROW + i], W[5 * _ROW + i]
            f, e, y0 = W[6 * _ROW + i], W[7 * _ROW + i], W[8 * _ROW + i]
            a1 = _acceleration(z, v, u0, k, c, g, b, f, e, y0)
            v2 = v + 0.5 * h * a1
            a2 = _acceleration(z + 0.5 * h * v, v2, u1, k, c, g, b, f, e, y0)
            v3 = v + 0.5 * h * a2
            a3 = _acceleration(z + 0.5 * h * v2, v3, u1, k, c, g, b, f, e, y0)
            v4 = v + h * a3
            a4 = _acceleration(z + h * v3, v4, u2, k, c, g, b, f, e, y0)
            W[i] = z + h / 6.0 * (v + 2.0 * v2 + 2.0 * v3 + v4)
            W[_ROW + i] = v + h / 6.0 * (a1 + 2.0 * a2 + 2.0 * a3 + a4)


@jit
def _polynomial(piece, tau):
    value = piece[-1]
    for n in range(len(piece) - 2, -1, -1):
        value = piece[n] + tau * value
    return value


@kernel
def run_samples(mean, cov, noises, walk, pieces, u, y, moving, substeps, free_energies, forecasts, memory):
    """Update a joint belief with T samples.

    Args:
        mean: (N_JOINT,) in the coordinates of `to_coordinates`; overwritten, as ``cov`` and ``noises``.
        cov: (N_JOINT, N_JOINT).
        noises: (4,) shapes and rates of q(γ) and q(ξ).
        walk: (K,) variances of the coefficients' random walk per sample.
        pieces: (T, degree + 1) the input on the way to each sample.
        u: (T,) inputs at the samples [V].
        y: (T,) outputs [V].
        moving: False if the first sample is the first ever, to which nothing has moved.
        substeps: Runge-Kutta steps per sample.
        free_energies: (T, iterations) receives the free energies [nats].
        forecasts: (T, 2) receives mean [V] and variance [V²] of each output before it was seen.
        memory: of `sigma_points.memory`, for expectations by sigma points; None for expectations to first order.
    """
    moved = np.empty(N_STATES)
    jacobian = np.zeros((N_STATES, N_JOINT))
    sensitivities = np.empty((N_STATES, N_MOTION))
    rows = np.empty((N_STATES, N_JOINT))
    work = np.empty((3, N_STATES, N_MOTION))
    gain = np.empty(N_JOINT)
    readout = np.zeros(N_JOINT)
    readout[0] = 1.0
    direction = NOISE_DIRECTION.copy()
    for t in range(len(y)):
        if moving or t > 0:
            if memory is None:
                moved[0], moved[1] = flow(
                    mean[0], mean[1], mean[N_STATES:N_MOTION], pieces[t], substeps, sensitivities, work
                )  # fmt: skip
                jacobian[:, :N_MOTION] = sensitivities
                joint.predict(mean, cov, moved, jacobian, walk, rows)
            else:
                columns, points = memory
                pairs = sigma_points.spread(mean, cov, columns, points)
                flow_points(points, 2 * pairs, pieces[t], substeps)
                sigma_points.predict(mean, cov, points[:N_STATES], columns, pairs, walk)
        readout[N_JOINT - 1] = u[t]
        expected = mean[0] + mean[N_JOINT - 1] * u[t]
        forecasts[t, 0] = expected
        forecasts[t, 1] = joint.correct(
            mean, cov, readout, direction, y[t] - expected, noises, free_energies.shape[1], free_energies[t], gain
        )  # fmt: skip


@kernel
def simulate_samples(z, v, p, pieces, u, substeps, y):
    """Free run from (z, z'): the output (T,) after each of the pieces, into ``y``."""
    sensitivities = np.empty((N_STATES, N_MOTION))
    work = np.empty((3, N_STATES, N_MOTION))
    for t in range(len(y)):
        z, v = flow(z, v, p[:-1], pieces[t], substeps, sensitivities, work)
        y[t] = z + p[-1] * u[t]
