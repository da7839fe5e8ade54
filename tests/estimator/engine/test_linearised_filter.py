"""The linearised filter against its equations with matrices, and its adjoint against finite differences."""

import numpy as np
import pytest
from engine_cases import CASES, FIVE, block, put, random_inputs
from reference.filters import EPS, central, moved, path, spread
from tables import table

from estimator.engine import information_gradient, kernels
from estimator.engine.storage_layout import input_rows

SAMPLES = 12
#: Variances of unit process noise and of the sensors.
NOISE = 1e-4


def some_walk(case, seed):
    """Start, coefficients, inputs and noises; and outputs that follow the plant at about the noise."""
    rng = np.random.default_rng(seed)
    n, sensors = case.model.n_states, case.model.n_outputs
    z, c = np.array(case.center[:n]), np.array(case.center[n:])
    inputs = [0.2 * random_inputs(case, rng) for _ in range(SAMPLES)]  # larger ones let the cubes run away
    V = NOISE * np.cov(rng.standard_normal((n, 4 * n)))
    V = V.reshape(n, n)
    R = NOISE * rng.uniform(0.5, 2.0, sensors)
    y, state = [], z
    for taps in inputs:
        state = moved(case.plant, state, c, taps)
        u = sum(taps) if case.plant.substeps else taps[0]
        y.append(np.array(case.plant.show(state, c, u)) + np.sqrt(R) * rng.standard_normal(sensors))
    return z, V, c, inputs, R, y


def start(case, layout, z, V, c, noises, W, lane=0, lanes=1):
    """``noises``: variances of the process noise and of each sensor's."""
    states = list(case.model.states)
    values = dict(zip((*states, *case.model.coefficients), (*z, *c), strict=True)) | {"IS_COUNTED": 1.0}
    values |= {f"P_{i}_{k}": V[a, b] for a, i in enumerate(states) for b, k in enumerate(states) if a <= b}
    values |= dict(zip(("PROCESS_VARIANCE", *(f"R_{s}" for s in case.model.outputs)), noises, strict=True))
    put(W, layout, lanes, lane, values)


def feed(case, layout, taps, y, W, lane=0, lanes=1):
    values = dict(zip(input_rows(case.model, case.degree), taps, strict=True))
    if y is not None:
        values |= dict(zip((f"Y_{s}" for s in case.model.outputs), y, strict=True))
    put(W, layout, lanes, lane, values)


def matrix(W, layout, lanes, lane, rows, columns):
    """Rows ``<letter>_i_k`` as a matrix; the upper triangle twice where only that is there."""
    letter, first = rows
    at = lambda i, k: W[layout[f"{letter}_{i}_{k}"] * lanes + lane]  # noqa: E731
    if letter == "DX":
        return np.array([[at(i, k) for k in columns] for i in first])
    return np.array([[at(first[min(a, b)], first[max(a, b)]) for b in range(len(first))] for a in range(len(first))])


def walked(case, task, walks, observed, samples=SAMPLES):
    """Run lanes over their first samples: the block, and the predicted outputs by sample."""
    lanes = task.lanes
    W, shown = block(task.layout, lanes), []
    for lane, (z, V, c, _, R, _) in enumerate(walks):
        start(case, task.layout, z, V, c, (NOISE, *R), W, lane, lanes)
    for t in range(samples):
        for lane, (_, _, _, inputs, _, y) in enumerate(walks):
            feed(case, task.layout, inputs[t], y[t] if observed else None, W, lane, lanes)
        task.sample(W, case.model.substeps)
        if not observed:
            shown.append([W[task.layout[f"Y_PRED_{s}"] * lanes] for s in case.model.outputs])
    return W, np.array(shown)


@table("observed", [True, False])
@pytest.mark.parametrize("name", CASES)
def test_a_path_equals_its_equations(name, observed):
    case = CASES[name]
    task = kernels.compile_linearised_filter(case.model, case.degree, follows_outputs=observed, lanes=1)
    assert_equals_reference(case, task, observed)


def test_a_compiled_path_equals_its_equations():
    case = CASES["pendulum"]
    assert_equals_reference(
        case, kernels.compile_linearised_filter(case.model, case.degree, follows_outputs=True, lanes=4), True
    )


def assert_equals_reference(case, task, observed):
    walk = some_walk(case, 1)
    z, V, c, inputs, R, y = walk
    W, shown = walked(case, task, [walk] * task.lanes, observed)
    expected = path(case.plant, z, V, c, inputs, NOISE, R, y if observed else None)
    lanes, lane, layout = task.lanes, task.lanes - 1, task.layout
    at = lambda row: W[layout[row] * lanes + lane]  # noqa: E731
    states, names = list(case.model.states), list(case.model.coefficients)
    # Every sample rounds, and rounding errors grow with the plant; sensitivities sum over the samples.
    tolerance = EPS * case.operations * SAMPLES * expected.growth**2
    assert tolerance < 1e-8
    F = expected.information
    size = np.sqrt(np.diag(F))
    assert (
        np.abs(matrix(W, layout, lanes, lane, ("INFORMATION", names), names) - F) <= tolerance * np.outer(size, size)
    ).all()
    np.testing.assert_allclose([at(i) for i in states], expected.state, rtol=tolerance, atol=tolerance)
    std = np.sqrt(np.diag(expected.cov))
    V_end = matrix(W, layout, lanes, lane, ("P", states), states)
    assert (np.abs(V_end - expected.cov) <= tolerance * np.outer(std, std)).all()
    reach = np.abs(expected.sensitivity).max()
    Z_end = matrix(W, layout, lanes, lane, ("DX", states), names)
    np.testing.assert_allclose(Z_end, expected.sensitivity, atol=tolerance * reach, rtol=0)
    if observed:
        # An error of the innovations e counts 1/√S: it is 1e2 times the rounding error.
        enlarged = tolerance / np.sqrt(R.min())
        total = SAMPLES * len(R) * (1 + abs(np.log(R.min())))
        assert at("LOSS") == pytest.approx(expected.loss, abs=enlarged * total)
        slope = np.array([at(f"GRADIENT_{i}") for i in names])
        assert (np.abs(slope - expected.gradient) <= enlarged * size * np.sqrt(total)).all()
        assert np.abs(expected.gradient / size).max() > 0.1
    else:
        np.testing.assert_allclose(shown, expected.shown, rtol=tolerance, atol=tolerance)


@pytest.mark.parametrize("name", [*FIVE, "drag"])
def test_the_information_is_that_of_the_responses_slopes(name):
    """Without process noise and from a known state, F is the sum of squared output slopes, over r."""
    case = CASES[name]
    z, V, c, inputs, R, _ = some_walk(case, 2)
    task = kernels.compile_linearised_filter(case.model, case.degree, follows_outputs=False, lanes=1)
    W = block(task.layout, 1)
    start(case, task.layout, z, 0 * V, c, (0.0, *R), W)
    for taps in inputs:
        feed(case, task.layout, taps, None, W)
        task.sample(W, case.model.substeps)

    def response(c):
        state, shown = z, []
        for taps in inputs:
            state = moved(case.plant, state, c, taps)
            shown.append(case.plant.show(state, c, sum(taps) if case.plant.substeps else taps[0]))
        return np.array(shown)

    # Order 4 leaves the fifth derivative times the step's fourth power, 1e-12, and rounding over the step, 1e-13.
    slopes = central(response, c, 1e-3)
    expected = np.einsum("tsi,tsj,s->ij", slopes, slopes, 1 / R)
    names = list(case.model.coefficients)
    found = matrix(W, task.layout, 1, 0, ("INFORMATION", names), names)
    size = np.sqrt(np.diag(expected))
    np.testing.assert_allclose(found / np.outer(size, size), expected / np.outer(size, size), atol=1e-5)


def pieces_of(case, name, monkeypatch):
    """The adjoint: compiled for two equations, and as plain Python for the others."""
    if name in ("paper", "pendulum"):
        return information_gradient.compile_adjoint(case.model, case.degree)
    with monkeypatch.context() as plain:
        plain.setattr("estimator.engine.source_cache.jit_closure", lambda _: lambda function: function)
        plain.setattr("estimator.engine.source_cache.scalar_jit_from_source", lambda _: lambda function: function)
        return information_gradient.compile_adjoint.__wrapped__(case.model, case.degree)


@pytest.mark.parametrize("name", [*FIVE, "drag"])
def test_the_gradient_by_the_inputs_equals_differences(name, monkeypatch):
    """For a weighted sum of all results, with process noise and an uncertain start."""
    case = CASES[name]
    code = pieces_of(case, name, monkeypatch)
    z, V, c, _, R, _ = some_walk(case, 3)
    rng, n = np.random.default_rng(4), case.model.n_states
    begun = np.zeros(code.n_path)
    begun[:n] = z
    begun[n : n + n * (n + 1) // 2] = V[np.triu_indices(n)]
    inputs, C, N = 0.1 * rng.standard_normal(SAMPLES), code.coefficients(c), code.noises(np.array([NOISE, *R]))

    def forward(u, tape):
        """The final filter state, the information, and the first sensor's outputs."""
        (P, F), seen = code.begin(begun), []
        for t in range(SAMPLES):
            P, F, shown, _ = code.step(P, F, C, laid(u, t), N, tape, t)
            seen.append(shown)
        return np.array(P), np.array(F), np.array(seen)

    def laid(u, t):
        return code.input_coefficients(*(u[t - k] if t >= k else 0.0 for k in range(3)))

    tape = np.empty((SAMPLES, code.n_tape))
    ends = forward(inputs, tape)
    # Weights that scale all results to the same size.
    weights = [rng.standard_normal(end.shape) / np.maximum(np.abs(end), 1e-3) for end in ends[:2]]
    weights.append(rng.standard_normal(SAMPLES))
    G, found = tuple(weights[0]), np.zeros(SAMPLES + 2)
    for t in reversed(range(SAMPLES)):
        G, *slopes = code.backward(G, tuple(weights[1]), C, laid(inputs, t), N, weights[2][t], tape, t)
        found[t : t + 3] += slopes[::-1]  # of the inputs two samples before, one before, and now
    # Directions that share no input with one another: an error in any slope is one in the sum that it stands in.
    directions = np.arange(SAMPLES) % 3 == np.arange(3)[:, None]
    directions = directions * rng.uniform(0.5, 1.0, SAMPLES)

    def value(along):
        moved = forward(inputs + along @ directions, np.empty_like(tape))
        return sum((w * end).sum() for w, end in zip(weights, moved, strict=True))

    expected = central(value, np.zeros(3), 1e-3)
    assert np.abs(expected).max() > 1.0
    # Where a step crosses the bend of drag, differences are of order 1 in it, of what half of a second derivative is.
    tolerance = 1e-3 if name == "drag" else 1e-6
    np.testing.assert_allclose(directions @ found[2:], expected, rtol=0, atol=tolerance * np.abs(expected).max())


def test_a_finished_lane_contributes_nothing():
    case = CASES["paper"]
    task = kernels.compile_linearised_filter(case.model, case.degree, follows_outputs=True, lanes=1)
    z, V, c, inputs, R, y = some_walk(case, 5)
    W = block(task.layout, 1)
    start(case, task.layout, z, V, c, (NOISE, *R), W)
    W[task.layout["IS_COUNTED"]] = 0.0
    feed(case, task.layout, inputs[0], y[0], W)
    task.sample(W, case.model.substeps)
    totals = [
        W[place] for row, place in task.layout.items() if row == "LOSS" or row.startswith(("INFORMATION_", "GRADIENT_"))
    ]
    np.testing.assert_array_equal(totals, 0.0)


def test_the_noise_of_a_linear_oscillator_is_the_integral_of_its_response():
    """The reference itself: N = ∫ Φ(τ) g gᵀ Φ(τ)ᵀ dτ, with the matrix exponential for Φ."""
    from scipy.linalg import expm

    case = CASES["duffing"]
    c = np.array([0.45, 0.0, 0.08, 0.5])
    A, g = np.array([[0.0, 1.0], [-c[0], -c[2]]]), np.array([0.0, np.sqrt(3.0)])
    nodes, weights = np.polynomial.legendre.leggauss(20)
    flows = [expm(A * (1 + x) / 2) @ g for x in nodes]
    expected = sum(w / 2 * np.outer(f, f) for w, f in zip(weights, flows, strict=True))
    # Runge and Kutta's error is h⁴/120 of the fifth derivative, which is at most (2 |A|)⁴ |g|², with |A| about 1.
    np.testing.assert_allclose(spread(case.plant, np.zeros(2), c, [0.0, 0.0]), expected, rtol=1e-4)
