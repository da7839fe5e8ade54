"""Filters of peer packages on the Silverbox record. Runs in the peers' environment (`benchmarks.peers`).

It imports nothing of ours. `benchmarks.estimators` times the filters with the paper's model. In the Silverbox protocol
every online peer goes once through the training section and, where it makes forecasts, on through the multisine test;
`benchmarks.silverbox_comparison` writes its inputs and judges its results. Models are in the coordinates of
`estimator.models`: the state and the coefficients together are Gaussian, and the coefficients are constant.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

Given = dict[str, Any]

#: Goes through the first samples; returns the means (L, n) after each of L numbers of samples, and the forecasts (F, 2)
#: of the outputs after the last of these numbers, mean and variance; None where the peer makes none.
Identify = Callable[[int, Sequence[int]], tuple[Any, Any]]

FASTCAN_TERMS, FASTCAN_DELAY, FASTCAN_DEGREE = 15, 3, 3


@dataclass(frozen=True)
class Model:
    """The model of a filter: a joint state of two states and the coefficients.

    Attributes:
        mean: (n,) predicted for the first sample.
        cov: (n, n) predicted for the first sample, without process noise.
        process_cov: (n, n), of each sample, the first included.
        measurement_cov: (1, 1).
        move: the two states after the next sample, from a joint state and that sample's taps (u_t, u_{t-1}, u_{t-2}).
        read: the output, from a joint state and the taps.
    """

    mean: Any
    cov: Any
    process_cov: Any
    measurement_cov: Any
    move: Callable[[Any, Any], tuple[Any, Any]]
    read: Callable[[Any, Any], Any]


def repeat(steps: int, body: Callable[[Any, Any], Any], carry: Any) -> Any:
    """Python's loop, with the arguments of a compiled one."""
    for s in range(steps):
        carry = body(s, carry)
    return carry


def flow(substeps: int, loop: Callable[..., Any] = repeat) -> Callable[[Any, Any], tuple[Any, Any]]:
    """Moves (z, z') of a state (z, z', k, c, g, b, f, y0, d) over a sample, as `estimator.models.duffing` says.

    z'' = g u + f - c z' - k z - b (z - y0)³, input interpolated linearly, Runge-Kutta of order 4; time in samples.
    """
    h = 1.0 / substeps

    def move(state: Any, taps: Any) -> tuple[Any, Any]:
        k, c, g, b, f, y0 = (state[i] for i in range(2, 8))
        last, rise = taps[1], taps[0] - taps[1]

        def change(z: Any, v: Any, tau: Any) -> tuple[Any, Any]:
            x = z - y0
            return v, g * (last + tau * rise) + f - c * v - k * z - b * x * x * x

        def step(s: Any, motion: tuple[Any, Any]) -> tuple[Any, Any]:
            z, v = motion
            z1, v1 = change(z, v, s * h)
            z2, v2 = change(z + 0.5 * h * z1, v + 0.5 * h * v1, (s + 0.5) * h)
            z3, v3 = change(z + 0.5 * h * z2, v + 0.5 * h * v2, (s + 0.5) * h)
            z4, v4 = change(z + h * z3, v + h * v3, (s + 1.0) * h)
            return z + h / 6.0 * (z1 + 2.0 * z2 + 2.0 * z3 + z4), v + h / 6.0 * (v1 + 2.0 * v2 + 2.0 * v3 + v4)

        moved: tuple[Any, Any] = loop(substeps, step, (state[0], state[1]))
        return moved

    return move


def regression(terms: Sequence[tuple[int, int, int]]) -> Callable[[Any, Any], tuple[Any, Any]]:
    """Moves (x_t, x_{t-1}) of a state (x_t, x_{t-1}, c_1, ...) by Σ c x_{t-1}^a x_{t-2}^b u_{t-d}; d < 0: no input."""

    def move(state: Any, taps: Any) -> tuple[Any, Any]:
        x1, x2 = state[0], state[1]
        moved = 0.0
        for i, (a, b, tap) in enumerate(terms):
            value = state[2 + i]
            value = value * x1**a if a else value
            value = value * x2**b if b else value
            moved = moved + (value * taps[tap] if tap >= 0 else value)
        return moved, x1

    return move


def model(given: Given, name: str, substeps: int | None = None, loop: Callable[..., Any] = repeat) -> Model:
    """The model of this name; ``substeps`` replaces an ODE's Runge-Kutta steps per sample, ``loop`` repeats them."""
    mean, cov = given[f"{name}_mean"], given[f"{name}_cov"]
    direction = np.zeros(len(mean))
    direction[:2] = given[f"{name}_direction"]
    process_cov = float(given[f"{name}_process_variance"]) * np.outer(direction, direction)
    measurement_cov = np.array([[float(given[f"{name}_measurement_variance"])]])
    noises = (process_cov, measurement_cov)
    if f"{name}_terms" in given:
        return Model(mean, cov, *noises, regression(given[f"{name}_terms"].tolist()), lambda state, taps: state[0])
    move = flow(substeps or int(given[f"{name}_substeps"]), loop)
    return Model(mean, cov, *noises, move, lambda state, taps: state[0] + state[8] * taps[0])


def taps_of(u: Any) -> Any:
    """(T, 3) the inputs u_t, u_{t-1}, u_{t-2} of each sample; 0 before the first."""
    return np.column_stack([u, np.r_[0.0, u[:-1]], np.r_[0.0, 0.0, u[:-2]]])


def dynamax_ekf(given: Given, name: str) -> Identify:
    """The extended Kalman filter of dynamax: one compiled scan, float64, Jacobians by its automatic differentiation.

    It conditions first, and then predicts with the next sample's taps. It gets the model's own Runge-Kutta steps, in a
    compiled loop: unrolled, they are many times slower.
    """
    from functools import partial

    import jax
    import jax.numpy as jnp
    from dynamax.nonlinear_gaussian_ssm import ParamsNLGSSM, extended_kalman_filter

    ours = model(given, name, loop=partial(jax.lax.fori_loop, 0))

    def transition(state: Any, taps: Any) -> Any:
        return jnp.concatenate([jnp.stack(ours.move(state, taps)), state[2:]])

    def emission(state: Any, taps: Any) -> Any:
        return jnp.stack([ours.read(state, taps)])

    def parameters() -> Any:
        return ParamsNLGSSM(
            initial_mean=jnp.asarray(ours.mean),
            initial_covariance=jnp.asarray(ours.cov + ours.process_cov),
            dynamics_function=transition,
            dynamics_covariance=jnp.asarray(ours.process_cov),
            emission_function=emission,
            emission_covariance=jnp.asarray(ours.measurement_cov),
        )

    @jax.jit
    def last_mean(y: Any, taps: Any) -> Any:
        return extended_kalman_filter(parameters(), y, taps, output_fields=["filtered_means"]).filtered_means[-1]

    @partial(jax.jit, static_argnames="lengths")
    def everything(y: Any, taps: Any, lengths: tuple[int, ...]) -> Any:
        fields = ["filtered_means", "predicted_means", "predicted_covariances"]
        posterior = extended_kalman_filter(parameters(), y, taps, output_fields=fields)
        first = lengths[-1] - 1  # predictions begin with the second sample's
        means, covs = posterior.predicted_means[first:], posterior.predicted_covariances[first:]
        inputs = taps[first + 1 :]
        slopes = jax.vmap(jax.jacfwd(emission))(means, inputs)[:, 0]
        variances = jnp.einsum("ti,tij,tj->t", slopes, covs, slopes) + ours.measurement_cov[0, 0]
        expected = jax.vmap(emission)(means, inputs)[:, 0]
        return posterior.filtered_means[jnp.asarray(lengths) - 1], jnp.column_stack([expected, variances])

    def identify(samples: int, lengths: Sequence[int]) -> tuple[Any, Any]:
        with jax.enable_x64(True):
            y, taps = jnp.asarray(given["y"][:samples, None]), jnp.asarray(taps_of(given["u"][:samples]))
            if lengths:
                return jax.block_until_ready(everything(y, taps, tuple(lengths)))
            return last_mean(y, taps).block_until_ready()[None], None

    return identify


def filterpy_ukf(given: Given, name: str) -> Identify:
    """The unscented Kalman filter of filterpy, with 2 Runge-Kutta steps per sample, which simulate as well as 8."""
    from filterpy.kalman import MerweScaledSigmaPoints, UnscentedKalmanFilter

    ours = model(given, name, substeps=2)
    n = len(ours.mean)

    def transition(state: Any, dt: float, taps: Any) -> Any:
        joint = state.tolist()
        joint[:2] = ours.move(joint, taps)
        return joint

    def stay(state: Any, dt: float) -> Any:
        return state

    def emission(state: Any, taps: Any) -> Any:
        return [ours.read(state, taps)]

    def identify(samples: int, lengths: Sequence[int]) -> tuple[Any, Any]:
        points = MerweScaledSigmaPoints(n, alpha=0.1, beta=2.0, kappa=3.0 - n)
        ukf = UnscentedKalmanFilter(n, 1, 1.0, hx=emission, fx=transition, points=points)
        ukf.x, ukf.P, ukf.Q, ukf.R = ours.mean.copy(), ours.cov.copy(), ours.process_cov, ours.measurement_cov
        means, forecasts = [], []
        last = lengths[-1] if lengths else samples
        ukf.predict(fx=stay)
        for t, (taps, y) in enumerate(zip(taps_of(given["u"][:samples]).tolist(), given["y"].tolist(), strict=False)):
            if t:
                ukf.predict(taps=taps)
            ukf.update(y, taps=taps)
            if t >= last:
                forecasts.append([y - float(ukf.y[0]), float(ukf.S[0, 0])])
            if t + 1 in lengths:
                means.append(ukf.x.copy())
        return np.array(means or [ukf.x]), np.array(forecasts)

    return identify


def padasip_rls(given: Given, name: str) -> Identify:
    """The recursive least squares of padasip, on measured outputs in the place of the states: no forgetting."""
    from padasip.filters import FilterRLS

    terms = given[f"{name}_terms"].tolist()
    y, taps = given["y"], taps_of(given["u"])
    lag1, lag2 = np.r_[0.0, y[:-1]], np.r_[0.0, 0.0, y[:-2]]
    regressors = np.column_stack(
        [lag1**a * lag2**b * (taps[:, tap] if tap >= 0 else np.ones(len(y))) for a, b, tap in terms]
    )

    def identify(samples: int, lengths: Sequence[int]) -> tuple[Any, Any]:
        rls = FilterRLS(len(terms), mu=1.0, eps=1e-6, w="zeros")
        means, start = [], 2
        for stop in lengths or [samples]:
            rls.run(y[start:stop], regressors[start:stop])
            means.append(np.r_[0.0, 0.0, rls.w])
            start = stop
        return np.array(means), None

    return identify


ONLINE: dict[str, Callable[[Given, str], Identify]] = {
    "dynamax": dynamax_ekf,
    "filterpy": filterpy_ukf,
    "padasip": padasip_rls,
}


def row(given: Given, peer: str, name: str, what: str) -> Callable[[int], dict[str, Any]]:
    """A row, set up.

    Args:
        given: what `benchmarks.silverbox_comparison` or `benchmarks.estimators` wrote.
        peer: a key of `ONLINE`, or ``fastcan``.
        name: of the model.
        what: ``time`` goes through the samples that are timed, ``count`` times, and says at which mean it ends;
            ``protocol`` goes through all, once.
    """
    if peer == "fastcan":
        return lambda count: fastcan_narx(given)
    identify = ONLINE[peer](given, name)
    timed, lengths = int(given["timed"]), given["lengths"].tolist()

    def time_it(count: int) -> dict[str, Any]:
        started = time.perf_counter()
        for _ in range(count):
            means, _ = identify(timed, ())
        seconds = time.perf_counter() - started
        return {"seconds": seconds, "work": count * timed, "mean": np.asarray(means[-1]).tolist()}

    def protocol(count: int) -> dict[str, Any]:
        means, forecasts = identify(len(given["y"]), lengths)
        return {
            "means": np.asarray(means).tolist(),
            "forecasts": None if forecasts is None else np.asarray(forecasts).tolist(),
        }

    return {"time": time_it, "protocol": protocol}[what]


def fastcan_narx(given: Given) -> dict[str, Any]:
    """The polynomial NARX of fastcan: selects terms, then minimises the simulation error. Offline; a fit per length.

    It also simulates, from the given first outputs. Where a fit fails, as with few samples, its simulations are NaN.
    """
    from fastcan.narx import make_narx

    def simulate(narx: Any, test: str) -> Any:
        u, first = given[f"{test}_u"], given[f"{test}_given"]
        if narx is None:
            return np.full(len(u), np.nan)
        begun = len(first) - narx.max_delay_
        return np.r_[first[:begun], narx.predict(u[begun:, None], y_init=first[begun:])]

    simulations = {}
    for length in given["lengths"].tolist():
        u, y = given["u"][:length, None], given["y"][:length]
        started = time.perf_counter()
        try:
            narx = make_narx(
                u, y, FASTCAN_TERMS, max_delay=FASTCAN_DELAY, poly_degree=FASTCAN_DEGREE, verbose=0, refine_verbose=0
            )  # fmt: skip
            narx.fit(u, y, coef_init="one_step_ahead")
        except (ValueError, np.linalg.LinAlgError):
            narx = None
        seconds = time.perf_counter() - started
        simulations[length] = simulate(narx, "arrow").tolist()
    return {
        "seconds": seconds,
        "work": length,
        "learning": simulations,
        "simulations": {test: simulate(narx, test).tolist() for test in given["tests"].tolist()},
    }
