"""Physical parameters and difference-equation coefficients of the Duffing oscillator.

The oscillator m x'' + c x' + a x + b x³ = u + w with output y = x + v (Kouw 2020, Eq. 1),
discretised with a central difference for x'' and a forward difference for x', is the recursion

    x[t+1] = θ1 x[t] + θ2 x[t]³ + θ3 x[t-1] + η u[t] + w̃[t],    Var w̃ = 1/γ        (Eq. 2)

The recursion is linear in its coefficients, so those are what is estimated. This module maps
between the two descriptions (Eqs. 3 and 4) and carries uncertainty along.

Displacement and input are both in volts, as in the Silverbox record. Vectors and matrices order
the parameters as (m, c, a, b) and the coefficients as (θ1, θ2, θ3, η).
"""

import dataclasses
from functools import lru_cache
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

FloatArray: TypeAlias = npt.NDArray[np.float64]
FloatOrArray: TypeAlias = float | FloatArray

SAMPLING_STEP = 2**14 / 1e7
"""Time between two samples of the Silverbox record, in seconds (610.35 Hz)."""

QUADRATURE_NODES = 20
"""Nodes per axis: the log-uniform moments converge to 1e-10 for every spread up to 0.999."""


@dataclasses.dataclass(frozen=True)
class PhysicalParameters:
    """Parameters of Eq. (1): of one oscillator, or of a batch of them.

    Fields may be floats or arrays (anything NumPy turns into floats). They are copied and
    broadcast against one another: afterwards all six are floats, or all six are float64 arrays
    of one shape. Signs of m, c, a and b are free, because estimates may take any.

    A precision that is left out is infinite, which means that this noise is absent.

    Attributes:
        m: Mass [s²].
        c: Damping [s].
        a: Linear stiffness [1].
        b: Cubic stiffness [V⁻²].
        tau: Process precision τ = 1 / Var w [V⁻²], in (0, inf].
        xi: Measurement precision ξ = 1 / Var v [V⁻²], in (0, inf].

    Raises:
        ValueError: If m, c, a or b is not finite, a precision is not positive, or the shapes do
            not broadcast. The message names the first offending entry.
    """

    m: FloatOrArray
    c: FloatOrArray
    a: FloatOrArray
    b: FloatOrArray
    tau: FloatOrArray = np.inf
    xi: FloatOrArray = np.inf

    def __post_init__(self) -> None:
        _settle_fields(self, precisions=("tau", "xi"))


@dataclasses.dataclass(frozen=True)
class Coefficients:
    """Coefficients of Eq. (2): of one difference equation, or of a batch of them.

    Fields are broadcast, and precisions may be left out, as in `PhysicalParameters`.

    Attributes:
        theta1: Weight of x[t] [1].
        theta2: Weight of x[t]³ [V⁻²].
        theta3: Weight of x[t-1] [1].
        eta: Gain of the input [1].
        gamma: Transition precision γ = 1 / Var w̃ [V⁻²], in (0, inf].
        xi: Measurement precision ξ = 1 / Var v [V⁻²], in (0, inf].

    Raises:
        ValueError: If theta1, theta2, theta3 or eta is not finite, a precision is not positive,
            or the shapes do not broadcast. The message names the first offending entry.
    """

    theta1: FloatOrArray
    theta2: FloatOrArray
    theta3: FloatOrArray
    eta: FloatOrArray
    gamma: FloatOrArray = np.inf
    xi: FloatOrArray = np.inf

    def __post_init__(self) -> None:
        _settle_fields(self, precisions=("gamma", "xi"))


def to_coefficients(parameters: PhysicalParameters, step: float = SAMPLING_STEP) -> Coefficients:
    """Map physical parameters to coefficients, Eq. (3).

    Args:
        parameters: One oscillator or a batch.
        step: Sampling step δ [s], positive.

    Returns:
        The coefficients, in the shape of `parameters`; ξ is passed on. Inverse of `to_physical`
        up to rounding.

    Raises:
        ValueError: If `step` is not positive and finite, or m + c δ is 0.
    """
    divisor = _common_divisor(parameters, step)
    eta = step**2 / divisor
    return Coefficients(
        theta1=(2 * parameters.m + parameters.c * step - parameters.a * step**2) / divisor,
        theta2=-parameters.b * eta,
        theta3=-parameters.m / divisor,
        eta=eta,
        # w̃ = η w, hence Var w̃ = η² Var w.
        gamma=parameters.tau / eta**2,
        xi=parameters.xi,
    )


def to_physical(coefficients: Coefficients, step: float = SAMPLING_STEP) -> PhysicalParameters:
    """Map coefficients to physical parameters, Eq. (4).

    Args:
        coefficients: One difference equation or a batch.
        step: Sampling step δ [s], positive.

    Returns:
        The parameters, in the shape of `coefficients`; ξ is passed on. Inverse of
        `to_coefficients` up to rounding.

    Raises:
        ValueError: If `step` is not positive and finite, or η is 0.
    """
    _require_step(step)
    theta1, theta3, eta = coefficients.theta1, coefficients.theta3, coefficients.eta
    _reject(
        np.equal(eta, 0),
        "eta",
        eta,
        rule="must not be 0",
        remedy="no oscillator has a zero gain, so leave this entry out or estimate it again",
    )
    return PhysicalParameters(
        m=-theta3 * step**2 / eta,
        c=(1 + theta3) * step / eta,
        a=(1 - theta1 - theta3) / eta,
        b=-coefficients.theta2 / eta,
        tau=coefficients.gamma * eta**2,
        xi=coefficients.xi,
    )


def coefficients_jacobian(parameters: PhysicalParameters, step: float = SAMPLING_STEP) -> FloatArray:
    """Differentiate Eq. (3).

    Args:
        parameters: One oscillator or a batch of shape (...).
        step: Sampling step δ [s], positive.

    Returns:
        d(θ1, θ2, θ3, η) / d(m, c, a, b), shape (..., 4, 4): rows are coefficients.

    Raises:
        ValueError: As `to_coefficients`.
    """
    psi = to_coefficients(parameters, step)
    return _quotient_jacobian(
        values=np.stack([psi.theta1, psi.theta2, psi.theta3, psi.eta], axis=-1),
        divisor=_common_divisor(parameters, step),
        numerator_slopes=np.array(
            [
                [2.0, step, -(step**2), 0.0],
                [0.0, 0.0, 0.0, -(step**2)],
                [-1.0, 0.0, 0.0, 0.0],
                [0.0, 0.0, 0.0, 0.0],
            ]
        ),
        divisor_slopes=np.array([1.0, step, 0.0, 0.0]),
    )


def physical_jacobian(coefficients: Coefficients, step: float = SAMPLING_STEP) -> FloatArray:
    """Differentiate Eq. (4).

    Args:
        coefficients: One difference equation or a batch of shape (...).
        step: Sampling step δ [s], positive.

    Returns:
        d(m, c, a, b) / d(θ1, θ2, θ3, η), shape (..., 4, 4): rows are parameters.

    Raises:
        ValueError: As `to_physical`.
    """
    phi = to_physical(coefficients, step)
    return _quotient_jacobian(
        values=np.stack([phi.m, phi.c, phi.a, phi.b], axis=-1),
        divisor=coefficients.eta,
        numerator_slopes=np.array(
            [
                [0.0, 0.0, -(step**2), 0.0],
                [0.0, 0.0, step, 0.0],
                [-1.0, 0.0, -1.0, 0.0],
                [0.0, -1.0, 0.0, 0.0],
            ]
        ),
        divisor_slopes=np.array([0.0, 0.0, 0.0, 1.0]),
    )


def propagate_to_physical(
    coefficients_mean: FloatArray, coefficients_cov: FloatArray, step: float = SAMPLING_STEP
) -> tuple[FloatArray, FloatArray]:
    """Carry a mean and covariance of the coefficients through Eq. (4), to first order.

    Good while the standard deviation of η is small beside its mean: the neglected terms are of
    the order of that ratio squared.

    Args:
        coefficients_mean: Mean of (θ1, θ2, θ3, η), shape (..., 4).
        coefficients_cov: Their covariance, shape (..., 4, 4) with the same leading shape.
            Symmetric and positive semi-definite, which is not checked.
        step: Sampling step δ [s], positive.

    Returns:
        Mean (..., 4) and covariance (..., 4, 4) of (m, c, a, b): Eq. (4) at the mean, and
        J Σ Jᵀ with J the `physical_jacobian` at the mean.

    Raises:
        ValueError: If the shapes do not match, an entry is not finite, or as `to_physical`.
    """
    mean = np.asarray(coefficients_mean, dtype=np.float64)
    cov = np.asarray(coefficients_cov, dtype=np.float64)
    if mean.shape[-1:] != (4,) or cov.shape != (*mean.shape, 4):
        raise ValueError(
            "coefficients_mean must have shape (..., 4) and coefficients_cov (..., 4, 4), but "
            f"they have {mean.shape} and {cov.shape}; give one 4 by 4 covariance for each mean"
        )
    _require_finite("coefficients_mean", mean)
    _require_finite("coefficients_cov", cov)
    coefficients = Coefficients(*np.moveaxis(mean, -1, 0))
    phi = to_physical(coefficients, step)
    jacobian = physical_jacobian(coefficients, step)
    return (
        np.stack([phi.m, phi.c, phi.a, phi.b], axis=-1),
        jacobian @ cov @ np.swapaxes(jacobian, -1, -2),
    )


def log_uniform_moments(
    center: PhysicalParameters, spread: float, step: float = SAMPLING_STEP
) -> tuple[FloatArray, FloatArray]:
    """Give the moments of the coefficients of an oscillator known only up to a factor.

    m, c, a and b are independent, each log-uniform (density proportional to 1/value) on
    [center (1 - spread), center (1 + spread)]. The moments of the coefficients that follow are
    integrated by tensor Gauss-Legendre quadrature over the logarithms.

    Args:
        center: One oscillator with m, c, a and b positive; its precisions are not used.
        spread: Relative half-width of the intervals, in [0, 1).
        step: Sampling step δ [s], positive.

    Returns:
        Mean (4,) and covariance (4, 4) of (θ1, θ2, θ3, η).

    Raises:
        ValueError: If `center` is a batch or not positive, `spread` is not in [0, 1), or `step`
            is not positive and finite.
    """
    if not 0 <= spread < 1:
        raise ValueError(f"spread must be in [0, 1), but is {spread}; log-uniform intervals must stay positive")
    if np.ndim(center.m) > 0:
        raise ValueError(
            f"center must be one oscillator, but is a batch of shape {np.shape(center.m)}; "
            "call once for each oscillator"
        )
    for name in ("m", "c", "a", "b"):
        value = getattr(center, name)
        if value <= 0:
            raise ValueError(f"center.{name} must be positive, but is {value}; a log-uniform interval lies above zero")
    mean, cov = _integrated(*(float(getattr(center, name)) for name in ("m", "c", "a", "b")), float(spread), step)
    return mean.copy(), cov.copy()


@lru_cache(maxsize=64)  # every environment asks for them, and the quadrature is most of what it costs to make one
def _integrated(
    center_m: float, center_c: float, center_a: float, center_b: float, spread: float, step: float
) -> tuple[FloatArray, FloatArray]:
    """The moments that `log_uniform_moments` gives."""
    nodes, weights = np.polynomial.legendre.leggauss(QUADRATURE_NODES)
    # log(1 ± spread) = log(1 - spread²) / 2 ± artanh(spread)
    factors = np.sqrt(1 - spread**2) * np.exp(np.arctanh(spread) * nodes)
    m, c, a, b = np.stack(np.meshgrid(*[factors] * 4, indexing="ij")).reshape(4, -1)
    psi = to_coefficients(
        PhysicalParameters(m=center_m * m, c=center_c * c, a=center_a * a, b=center_b * b),
        step,
    )
    points = np.stack([psi.theta1, psi.theta2, psi.theta3, psi.eta], axis=-1)
    per_axis = weights / 2  # the weights sum to 2, the length of [-1, 1]
    probabilities = np.einsum("i,j,k,l->ijkl", *[per_axis] * 4).ravel()
    # Plain sums, because the last digits of a BLAS product depend on its number of threads.
    mean = np.array([(probabilities * column).sum() for column in points.T])
    deviations = points - mean
    cov = np.array([[(probabilities * (one * other)).sum() for one in deviations.T] for other in deviations.T])
    return mean, cov


def _common_divisor(parameters: PhysicalParameters, step: float) -> FloatOrArray:
    """Return m + c δ, the divisor of every coefficient in Eq. (3)."""
    _require_step(step)
    divisor = parameters.m + parameters.c * step
    _reject(
        np.equal(divisor, 0),
        "(m + c * step)",
        divisor,
        rule="must not be 0",
        remedy="Eq. (3) divides by it, so change m, c or step",
    )
    return divisor


def _quotient_jacobian(
    values: FloatArray,
    divisor: FloatOrArray,
    numerator_slopes: FloatArray,
    divisor_slopes: FloatArray,
) -> FloatArray:
    """Differentiate v = n / d: dv = (dn - v dd) / d, for four quotients with one divisor."""
    return (numerator_slopes - values[..., np.newaxis] * divisor_slopes) / np.asarray(divisor)[
        ..., np.newaxis, np.newaxis
    ]


def _settle_fields(record: PhysicalParameters | Coefficients, precisions: tuple[str, ...]) -> None:
    """Broadcast the fields of a new record to one shape and check their ranges."""
    names = [field.name for field in dataclasses.fields(record)]
    arrays = [np.asarray(getattr(record, name), dtype=np.float64) for name in names]
    try:
        shape = np.broadcast_shapes(*(array.shape for array in arrays))
    except ValueError:
        shapes = ", ".join(f"{name} {a.shape}" for name, a in zip(names, arrays, strict=True))
        raise ValueError(
            f"fields must broadcast to one shape, but their shapes are {shapes}; "
            "give each field as a float or as an array over the batch"
        ) from None
    for name, array in zip(names, arrays, strict=True):
        if name in precisions:
            _reject(
                ~(array > 0),
                name,
                array,
                rule="must be positive",
                remedy="it is 1 / variance, with inf for an absent noise",
            )
        else:
            _require_finite(name, array)
        # The copy keeps what was checked: the caller may write into its own array later.
        settled = np.broadcast_to(array, shape).copy() if shape else float(array)
        object.__setattr__(record, name, settled)


def _require_step(step: float) -> None:
    if not (np.isfinite(step) and step > 0):
        raise ValueError(f"step must be positive and finite, but is {step}; give the seconds between two samples")


def _require_finite(name: str, values: FloatArray) -> None:
    _reject(
        ~np.isfinite(values),
        name,
        values,
        rule="must be finite",
        remedy="replace the entry or leave it out",
    )


def _reject(bad: npt.ArrayLike, name: str, values: FloatOrArray, *, rule: str, remedy: str) -> None:
    """Raise a ValueError that names the first entry of `values` marked as bad, if any is."""
    if not np.any(bad):
        return
    index = np.argwhere(bad)[0].tolist()
    entry = f"{name}{index}" if index else name
    raise ValueError(f"{name} {rule}, but {entry} is {np.asarray(values)[tuple(index)]}; {remedy}")


SILVERBOX_TWIN = PhysicalParameters(m=6.4568e-6, c=2.5717e-4, a=1.1747, b=3.7672)
"""The Silverbox circuit as the difference equation sees it (``python -m duffing_env.twin`` identifies it)."""

_GAIN_TWIN = 186_015.0  # s⁻²

CONTINUOUS_TWIN = PhysicalParameters(
    m=1 / _GAIN_TWIN, c=41.8992 / _GAIN_TWIN, a=184_255.0 / _GAIN_TWIN, b=730_155.0 / _GAIN_TWIN
)
"""The Silverbox circuit as the differential equation sees it (``python -m duffing_env.twin`` identifies it)."""
