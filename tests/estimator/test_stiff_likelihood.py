"""Stiff equations: however wrong the coefficients are, the likelihood has no hole, and its gradient is exact.

An innovation varies at least as much as its sensor's noise. A hole is a point whose loss is lower than with 64 times as
many Runge-Kutta steps as it asks for (8192 at most), by more than ten nats and a hundredth of its excess over the
lowest loss possible. It attracts a fit where that excess is below 50 nats for each output.
"""

import numpy as np
import pytest

from estimator import Model
from estimator.inference.converged_likelihood import converged_likelihoods
from estimator.inference.likelihood_gradient import likelihood_gradients
from estimator.inference.record_filter import record_likelihoods, with_substeps

#: Decades to each side of a coefficient's value from which points are drawn.
DECADES = 2.0
POINTS = 200

OVERFLOW_A, OVERFLOW_B = (f"1.5*max({tank} - 10, 0)" for tank in "ab")
ROOT_A, ROOT_B = (f"({tank}**2 + 1e-9)**(1/4)" for tank in "ab")


def in_samples(step, *rates):
    """Rates per second, as rates per sample."""
    return tuple(f"{step}*({rate})" for rate in rates)


#: Model, its coefficients' values, first state, input (T,), and sampling steps that the output is simulated with.
BIOREACTOR = Model(
    "bioreactor", {"x": "1", "s": "1"}, {"mu": "1", "k": "1", "yield_": "1"}, noise=("1", "1"), outputs={"y": "x"},
    rates=in_samples(0.5, "mu*s*x/(k + s) - u*x", "u*(5 - s) - mu*s*x/((k + s)*yield_)"),
)  # fmt: skip
MOTOR = Model(
    "motor", {"w": "rad/s", "i": "A"},
    {"kt": "1", "fv": "1", "fc": "1", "j": "1", "l": "1", "r": "1"}, noise=("1", "1"), outputs={"y": "w"},
    rates=in_samples(0.002, "(kt*i - fv*w - fc*tanh(w))/j", "(u - r*i - kt*w)/l"),
)  # fmt: skip
TANKS = Model(
    "tanks", {"a": "1", "b": "1"}, {"ku": "1", "ka": "1", "ea": "1", "kb": "1", "kc": "1", "ov": "1"},
    noise=("1", "1"), outputs={"y": "b"},
    rates=in_samples(
        4.0, f"ku*u - ka*{ROOT_A} + ea - ea*a - {OVERFLOW_A}",
        f"kb*{ROOT_A} - kc*{ROOT_B} + ov*{OVERFLOW_A} - {OVERFLOW_B}",
    ),
)  # fmt: skip


def held(rng, levels, hold, samples=400):
    return np.repeat(rng.uniform(*levels, samples // hold + 1), hold)[:samples]


CASES = {
    "bioreactor": (BIOREACTOR, (0.5, 0.3, 0.4), (1.5, 1.0), lambda rng: held(rng, (0.1, 0.4), 20)),
    "motor": (MOTOR, (0.1, 0.002, 0.05, 0.01, 0.005, 1.0), (0.0, 0.0), lambda rng: held(rng, (-6.0, 6.0), 150)),
    "tanks": (TANKS, (0.05, 0.06, 0.01, 0.06, 0.05, 0.5), (2.0, 2.0), lambda rng: held(rng, (0.5, 4.0), 50)),
}


class Problem:
    """A record of a case with 1 % noise, and points in four decades about each coefficient, with noises of six."""

    def __init__(self, name, count, seed=0):
        self.model, values, first, draw_input = CASES[name]
        rng = np.random.default_rng(seed)
        u = draw_input(rng)
        values, self.n_samples = np.array(values), len(u)
        response = np.empty((1, len(u), 1, 2))
        nothing, first = np.full((1, len(u), 1), np.nan), np.array(first)
        record_likelihoods(
            with_substeps(self.model, 64), values[None], u[None, :, None], nothing, np.array([1e-20, 1.0]),
            1e-12 * np.eye(2), first[None], forecasts=response,
        )  # fmt: skip
        self.std = 0.01 * response[..., 0].std()
        y = response[0, :, :, 0] + self.std * rng.standard_normal((len(u), 1))
        self.points = values * 10.0 ** rng.uniform(-DECADES, DECADES, (count, len(values)))
        process_stds = self.std * 10.0 ** rng.uniform(-3, 3, count)
        self.series = (
            np.tile(u[None, :, None], (count, 1, 1)),
            np.tile(y[None], (count, 1, 1)),
            np.stack([process_stds, np.full(count, self.std)], axis=1) ** 2,
        )
        self.start = self.std**2 * np.eye(2), np.tile(first, (count, 1))

    def run(self, function, substeps, chosen, points=None):
        """A function of the filter's arguments, for some of the points, in a number of Runge-Kutta steps."""
        at = self.points[chosen] if points is None else points
        cov, first = self.start
        return function(with_substeps(self.model, substeps), at, *(s[chosen] for s in self.series), cov, first[chosen])

    def holes(self, loss, reference):
        """Whether each loss is a hole, by a reference, and whether it is one that attracts a fit."""
        lowest = self.n_samples * np.log(self.std)
        is_hole = loss < reference - np.maximum(10.0, 0.01 * (reference - lowest))
        return is_hole, is_hole & (loss - lowest < 50 * self.n_samples)

    def holes_and_convergence(self):
        """The `holes` of all losses, those of losses in single steps, and which losses have converged."""
        every = np.arange(len(self.points))
        found = self.run(converged_likelihoods, self.model.substeps, every)
        reference = np.full(len(every), np.nan)
        for substeps in set(found.substeps[found.substeps > 0]):
            chosen = np.flatnonzero(found.substeps == substeps)
            reference[chosen] = self.run(record_likelihoods, min(64 * int(substeps), 8192), chosen).loss
        has_converged = found.substeps > 0
        plain = self.run(record_likelihoods, self.model.substeps, every).loss
        assert np.isinf(found.likelihoods.loss[~has_converged]).all()
        assert not np.isnan(found.likelihoods.loss).any()
        return self.holes(found.likelihoods.loss, reference), self.holes(plain, reference), has_converged


@pytest.mark.parametrize(("name", "seed"), [("bioreactor", 0), ("motor", 0), ("tanks", 0)])
def test_the_converged_likelihood_has_no_hole_where_that_in_single_steps_has_some(name, seed):
    (_, attracting), (_, attracting_in_single_steps), has_converged = Problem(name, 100, seed).holes_and_convergence()
    assert not attracting.any()
    assert attracting_in_single_steps.any()
    assert has_converged.mean() > 0.6


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_ten_thousand_points_have_few_holes(name):
    """Less than a third of those in single steps, and the motor none.

    Long steps over a pole at s = -k, or at an empty tank, leave some.
    """
    counts = np.zeros((2, 2))
    for seed in range(10):
        converged, single_steps, has_converged = Problem(name, 1000, seed).holes_and_convergence()
        counts += [[kind.sum() for kind in holes] for holes in (converged, single_steps)]
        assert has_converged.mean() > 0.6
    assert (counts[0] < counts[1] / 3).all()
    if name == "motor":
        assert not counts[0].any()


def checked_gradients(problem, function):
    """Largest errors of gradients by differences, in parts of the largest slope, where differences agree.

    They do not where a slope of the equation jumps, as at a full tank.
    """
    substeps = problem.run(converged_likelihoods, problem.model.substeps, np.arange(len(problem.points))).substeps
    errors = []
    for steps in set(substeps[(substeps > 0) & (substeps <= 64)]):
        chosen = np.flatnonzero(substeps == steps)
        points = problem.points[chosen]
        slopes = points * problem.run(function, int(steps), chosen)
        estimates = []
        for width in (2e-5, 4e-5):
            estimates.append(np.empty_like(slopes))
            for k in range(points.shape[1]):
                step = np.exp(width * (np.arange(points.shape[1]) == k))
                losses = [
                    problem.run(record_likelihoods, int(steps), chosen, points * step**j).loss for j in (-2, -1, 1, 2)
                ]
                estimates[-1][:, k] = np.array([1, -8, 8, -1]) @ losses / (12 * width)
        size = np.abs(estimates[0]).max(axis=1)
        agree = np.abs(estimates[0] - estimates[1]).max(axis=1) < 1e-7 * size
        errors += list((np.abs(slopes - estimates[0]).max(axis=1) / size)[agree])
    return np.array(errors)


def held_gradients(*arguments):
    """The gradient of the filter, which holds gains fixed."""
    return record_likelihoods(*arguments).gradient


@pytest.mark.parametrize("name", CASES)
def test_the_gradient_equals_differences(name):
    problem = Problem(name, 24, seed=1)
    errors = checked_gradients(problem, likelihood_gradients)
    assert len(errors) > 5
    assert errors.max() < 1e-6
    assert np.median(checked_gradients(problem, held_gradients)) > 1e-3


@pytest.mark.parametrize("name", CASES)
def test_no_innovation_varies_less_than_its_sensor(name):
    model, values, first, draw_input = CASES[name]
    rng = np.random.default_rng(0)
    u = draw_input(rng)
    points = np.array(values) * 10.0 ** rng.uniform(-DECADES, DECADES, (POINTS, len(values)))
    y = np.tile(first[0] + rng.standard_normal((1, len(u), 1)), (POINTS, 1, 1))
    forecasts = np.full((POINTS, len(u), 1, 2), np.nan)
    sensor_variance = 1e-4
    record_likelihoods(
        model, points, np.tile(u[None, :, None], (POINTS, 1, 1)), y, np.array([1e-2, sensor_variance]),
        1e-4 * np.eye(2), np.tile(first, (POINTS, 1)), forecasts=forecasts,
    )  # fmt: skip
    variances = forecasts[..., 1][np.isfinite(forecasts[..., 1])]
    assert len(variances) > 0.2 * POINTS * len(u)
    assert variances.min() >= sensor_variance * (1 - 1e-6)
