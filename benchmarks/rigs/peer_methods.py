"""Identification by dynamax, SciPy and pysindy, as a user would write it; runs in the environment of the peers.

Each method takes a `PeerProblem` and returns m, c, a and b. All start from the guess, and know the initial state, the
interpolation of the input, and whether the sensor has an offset. This module imports nothing of the project.
"""

# The peers are not installed where types are checked.
# mypy: disable-error-code="import-not-found"

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np

#: Lengths of the segments of multiple shooting, in order [samples].
SEGMENT_LENGTHS = (32, 256)


@dataclass(frozen=True)
class PeerProblem:
    """A record and the knowledge of its user, in the units of the rig.

    Attributes:
        u: (T,) inputs.
        y: (T,) outputs.
        step: sampling step [s].
        kind: kind of the output.
        interpolation: interpolation of the input.
        substeps: Runge-Kutta steps per sample that are enough.
        offset: whether the sensor has an offset.
        rest: displacement at rest at the start.
        guess: (4,) guess of m, c, a and b.
        process_noise: standard deviation of the force's disturbance per sample.
        sensor_noise: standard deviation of the sensor's noise.
    """

    u: Any
    y: Any
    step: float
    kind: str
    interpolation: str
    substeps: int
    offset: bool
    rest: float
    guess: Any
    process_noise: float
    sensor_noise: float


def inputs_at_substeps(problem: PeerProblem) -> Any:
    """(T, 2 S + 1) inputs at the ends and midpoints of S substeps from each sample to the next."""
    from scipy.interpolate import make_interp_spline

    u, substeps = problem.u, problem.substeps
    if problem.interpolation == "zero_order":
        return np.repeat(u[:, None], 2 * substeps + 1, axis=1)
    times = np.arange(len(u))[:, None] + np.linspace(0, 1, 2 * substeps + 1)
    return make_interp_spline(np.arange(len(u)), u, k=5)(np.minimum(times, len(u) - 1))


def rk4_sample(x: Any, v: Any, p: Any, forces: Any, step: float) -> tuple[Any, Any]:
    """Displacement and velocity one sample later; p are 1/m, c/m, a/m and b/m."""
    h = 2 * step / (len(forces) - 1)
    for s in range(0, len(forces) - 1, 2):
        x, v = rk4_substep(x, v, p, forces[s : s + 3], h)
    return x, v


def rk4_substep(x: Any, v: Any, p: Any, forces: Any, h: float) -> tuple[Any, Any]:
    """One Runge-Kutta step of h seconds, with the inputs at its start, midpoint and end."""
    first, middle, last = (p[0] * force for force in forces)
    k1 = first - p[1] * v - p[2] * x - p[3] * x**3
    x2, v2 = x + h / 2 * v, v + h / 2 * k1
    k2 = middle - p[1] * v2 - p[2] * x2 - p[3] * x2**3
    x3, v3 = x + h / 2 * v2, v + h / 2 * k2
    k3 = middle - p[1] * v3 - p[2] * x3 - p[3] * x3**3
    x4, v4 = x + h * v3, v + h * k3
    k4 = last - p[1] * v4 - p[2] * x4 - p[3] * x4**3
    return x + h / 6 * (v + 2 * v2 + 2 * v3 + v4), v + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)


def to_physical_parameters(p: Any) -> Any:
    """m, c, a and b from 1/m, c/m, a/m and b/m."""
    return np.array([1.0, p[1], p[2], p[3]]) / p[0]


def initial_guess(problem: PeerProblem) -> tuple[Any, float, float]:
    """The guess as 1/m, c/m, a/m, b/m, and sizes of x and of x'."""
    m, c, a, b = problem.guess
    omega = np.sqrt(abs(a) / m)
    power = {"displacement": 0, "velocity": 1, "acceleration": 2}[problem.kind]
    size = np.std(problem.y) / omega**power
    return np.array([1, c, a, b]) / m, size, size * omega


def run_filter(problem: PeerProblem, kalman_filter: Callable[..., Any]) -> Any:
    """Parameters by a filter (`dynamax_filter`) over a record, with the true noises."""
    import jax
    import jax.numpy as jnp

    guess, size, speed = initial_guess(problem)
    scale = np.array([size, speed, *guess, size if problem.kind == "displacement" else np.std(problem.y)])
    mean = np.array([problem.rest / size, 0.0, 1.0, 1.0, 1.0, 1.0, 0.0])
    std = np.array([0.1, 0.1, 0.4, 0.4, 0.4, 0.4, 0.3 if problem.offset else 0.0])
    kick = np.array([problem.step**2 / 2, problem.step, 0, 0, 0, 0, 0]) * guess[0] * problem.process_noise / scale
    sensor = problem.sensor_noise**2 + (
        (guess[0] * problem.process_noise) ** 2 if problem.kind == "acceleration" else 0.0
    )
    # The filter conditions on an output before it applies the inputs of that sample: so these precede the output.
    inputs = np.roll(inputs_at_substeps(problem), 1, axis=0)
    given = (mean, np.diag(std**2), np.outer(kick, kick) + 1e-24 * np.eye(7), np.array([[sensor]]), scale,
             problem.y[:, None], inputs)  # fmt: skip
    with jax.enable_x64(True):
        return to_physical_parameters(np.asarray(kalman_filter(*map(jnp.asarray, given)))[2:6] * guess)


def dynamax_filter(kind: str, step: float, propagate: Callable[..., Any]) -> Callable[..., Any]:
    """The filter of dynamax for the scaled joint state (x, v, four coefficients, sensor offset)."""
    import jax.numpy as jnp
    from dynamax.nonlinear_gaussian_ssm import ParamsNLGSSM, extended_kalman_filter

    def run(mean: Any, cov: Any, process_cov: Any, sensor_cov: Any, scale: Any, y: Any, inputs: Any) -> Any:
        def transition(state: Any, forces: Any) -> Any:
            s = state * scale
            x, v = propagate(s[0], s[1], s[2:6], forces, step)
            return jnp.concatenate([jnp.stack([x, v]) / scale[:2], state[2:]])

        def emission(state: Any, forces: Any) -> Any:
            x, v, g, c, a, b, offset = state * scale
            outputs = {"displacement": x, "velocity": v, "acceleration": g * forces[-1] - c * v - a * x - b * x**3}
            return jnp.stack([outputs[kind] + offset])

        model = ParamsNLGSSM(mean, cov, transition, process_cov, emission, sensor_cov)
        return extended_kalman_filter(model, y, inputs=inputs, output_fields=["filtered_means"]).filtered_means[-1]

    return run


def dynamax(problem: PeerProblem) -> Any:
    """The extended Kalman filter of dynamax, called as in its documentation."""
    return run_filter(problem, dynamax_filter(problem.kind, problem.step, rk4_sample))


def dynamax_jit(problem: PeerProblem) -> Any:
    """The same as a JAX expert would write it: with a loop in JAX, and compiled once for a rig."""
    return run_filter(problem, jitted_dynamax_filter(problem.kind, problem.step))


@cache
def jitted_dynamax_filter(kind: str, step: float) -> Callable[..., Any]:
    """A filter that JAX compiles as a whole, once for a rig."""
    import jax

    return jax.jit(dynamax_filter(kind, step, rk4_sample_scan))


def rk4_sample_scan(x: Any, v: Any, p: Any, forces: Any, step: float) -> tuple[Any, Any]:
    """`rk4_sample` with a loop in JAX, which would take seconds to compile the steps one by one."""
    import jax

    h = 2 * step / (len(forces) - 1)
    triples = jax.numpy.stack([forces[:-1:2], forces[1::2], forces[2::2]], axis=1)
    return jax.lax.scan(lambda xv, three: (rk4_substep(xv[0], xv[1], p, three, h), None), (x, v), triples)[0]


def multiple_shooting(problem: PeerProblem) -> Any:
    """Multiple shooting: SciPy's least squares over coefficients and the initial state of every segment."""
    guess = problem.guess
    for length in SEGMENT_LENGTHS:
        guess = fit_segments(replace(problem, guess=guess), length)
    return guess


def fit_segments(problem: PeerProblem, segment_length: int) -> Any:
    """Multiple shooting with segments of one length."""
    from scipy.optimize import least_squares

    guess, size, speed = initial_guess(problem)
    count = len(problem.y) // segment_length
    y = problem.y[: count * segment_length].reshape(count, segment_length).T
    forces = inputs_at_substeps(problem)[: count * segment_length].reshape(count, segment_length, -1).transpose(1, 2, 0)
    before = np.roll(problem.u, 1)[: count * segment_length].reshape(count, segment_length).T

    def outputs(p: Any, begin: Any, offset: Any) -> Any:
        x, v = begin[0] * size, begin[1] * speed
        p = p * guess.reshape(4, *[1] * (np.ndim(p) - 1))
        shown = []
        for k in range(segment_length):
            acceleration = p[0] * before[k] - p[1] * v - p[2] * x - p[3] * x**3
            shown.append({"displacement": x, "velocity": v, "acceleration": acceleration}[problem.kind] + offset)
            x, v = rk4_sample(x, v, p, forces[k], problem.step)
        return np.array(shown)

    def split(z: Any) -> tuple[Any, Any, Any]:
        return z[:4], z[5:].reshape(2, count), z[4] * np.std(problem.y) if problem.offset else 0.0

    def residuals(z: Any) -> Any:
        return ((outputs(*split(z)) - y) / problem.sensor_noise).ravel()

    def jacobian(z: Any) -> Any:
        small, slopes = 1e-6, np.zeros((segment_length, count, len(z)))
        middle = outputs(*split(z))
        for i in range(5 + 2):
            moved = z.copy()
            moved[i if i < 5 else slice(5 + (i - 5) * count, 5 + (i - 4) * count)] += small
            change = (outputs(*split(moved)) - middle) / small / problem.sensor_noise
            if i < 5:
                slopes[:, :, i] = change
            else:
                slopes[:, range(count), 5 + (i - 5) * count + np.arange(count)] = change
        return slopes.reshape(segment_length * count, -1)

    x, v = np.full_like(problem.y, problem.rest), np.zeros_like(problem.y)
    if problem.kind == "displacement":
        x, v = problem.y, np.gradient(problem.y, problem.step)
    if problem.kind == "velocity":
        v = problem.y
    firsts = np.arange(count) * segment_length
    z = np.concatenate([np.ones(4), [0.0], x[firsts] / size, v[firsts] / speed])
    found = least_squares(residuals, z, jacobian, x_scale="jac", method="lm", max_nfev=50)
    return to_physical_parameters(found.x[:4] * guess)


def pysindy(problem: PeerProblem) -> Any:
    """Regression by pysindy on derivatives by a Savitzky-Golay filter, with the true terms."""
    import pysindy as ps
    from scipy.signal import savgol_filter

    if problem.kind != "displacement":
        raise ValueError(f"pysindy needs the displacement, but the output is a {problem.kind}")
    _, size, speed = initial_guess(problem)
    tact = size / speed
    period = 2 * np.pi * tact / problem.step
    window = max(5, 2 * int(period / 12) + 1)
    x, v, acceleration = (
        savgol_filter(problem.y / size, window, 4, deriv=n, delta=problem.step / tact) for n in range(3)
    )
    u = problem.u / np.std(problem.u)
    u = (u + np.r_[0.0, u[:-1]]) / 2 if problem.interpolation == "zero_order" else u
    cubes = ps.CustomLibrary([lambda s: s**3], [lambda s: f"{s}^3"])
    terms = ps.GeneralizedLibrary(
        [ps.PolynomialLibrary(1, include_bias=problem.offset), cubes], inputs_per_library=[[0, 1, 2], [0]]
    )
    model = ps.SINDy(ps.STLSQ(threshold=0.0, alpha=1e-12), terms)
    states, rates = np.column_stack([x, v]), np.column_stack([v, acceleration])
    model.fit(states, t=problem.step / tact, x_dot=rates, u=u[:, None])
    found = model.coefficients()[1][int(problem.offset) :]
    gain = found[2] / np.std(problem.u)
    return np.array([1 / gain / size * tact**2, -found[1] / gain / size * tact, -found[0] / gain / size,
                     -found[3] / gain / size**3])  # fmt: skip


PEERS = {"dynamax": dynamax, "dynamax-jit": dynamax_jit, "scipy": multiple_shooting, "pysindy": pysindy}

#: Peer to the functions that its user writes, besides its own.
HELPERS: dict[str, tuple[Callable[..., Any], ...]] = {
    "dynamax": (
        inputs_at_substeps,
        rk4_sample,
        rk4_substep,
        to_physical_parameters,
        initial_guess,
        run_filter,
        dynamax_filter,
    ),
    "dynamax-jit": (
        inputs_at_substeps,
        rk4_sample_scan,
        rk4_substep,
        to_physical_parameters,
        initial_guess,
        run_filter,
        dynamax_filter,
        jitted_dynamax_filter,
    ),
    "scipy": (inputs_at_substeps, rk4_sample, rk4_substep, to_physical_parameters, initial_guess, fit_segments),
    "pysindy": (initial_guess,),
}


def row(given: dict[str, Any], peer: str, rig: str) -> Callable[[int], dict[str, Any]]:
    """A function of i that identifies the i-th record of a rig, and returns the parameters and the run time."""

    def run(i: int) -> dict[str, Any]:
        fields = {name: given[f"{rig}_{name}"] for name in PeerProblem.__dataclass_fields__}
        plain = {name: value.item() for name, value in fields.items() if np.ndim(value) == 0}
        problem = PeerProblem(**{name: value[i] for name, value in fields.items() if np.ndim(value) > 0}, **plain)
        started = time.perf_counter()
        found = PEERS[peer](problem)
        return {"seconds": time.perf_counter() - started, "work": 1, "parameters": np.asarray(found).tolist()}

    return run
