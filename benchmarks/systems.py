"""Systems for the coverage tables: drawn at random and simulated, with the prior that has the moments of the draw.

Every model has the four parameters of an oscillator near the twin of the Silverbox; what else it has is Gaussian about
0. All get inputs that are independent and uniform. The difference equations start at rest; of the physical equation the
start tells the offsets apart, and is therefore drawn as the prior has it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from estimator import NLARX, SILVERBOX_TWIN, DuffingODE, JointBelief, PhysicalParameters, Prior, to_coefficients
from estimator.lanes import kernel
from estimator.models.ode import N_JOINT, N_MOTION, N_STATES, flow, to_coordinates
from estimator.models.regressors import PRESETS, Term
from estimator.parameters import SAMPLING_STEP, FloatArray, log_uniform_moments

MODELS = ("paper", "offset", "three-tap", "cubic", "ode")

SPREAD = 0.3  # of the four: log-uniform on the twin's value * [1 - SPREAD, 1 + SPREAD]
MAX_INPUT = 0.15  # V; inputs are independent and uniform on ± this
MAX_DISPLACEMENT = 0.75  # V; above it the difference equations blow up, where the circuit does not
STATE_STD = 1e-3  # V, and V per sample; of the state's prior

#: The terms of Eq. (2), in the order of (θ1, θ2, θ3, η), and standard deviations of the other coefficients.
_FOUR = PRESETS["paper"]
_OTHERS = {Term(): 2e-3, Term(tap=0): 0.05, Term(tap=2): 0.05}
_PRODUCT = 0.1

#: Places of what the physical equation is not given within SPREAD: u0, y0, feedthrough.
_OFFSETS = (4, 6, 7)


@dataclass(frozen=True)
class Systems:
    """N systems and their records.

    Attributes:
        names: (K,) of what is to be identified.
        truth: (N, K) their true values.
        u: (N, T) inputs [V].
        y: (N, T) outputs [V].
        stayed: (N,) whether the displacement stayed below `MAX_DISPLACEMENT`.
    """

    names: tuple[str, ...]
    truth: FloatArray
    u: FloatArray
    y: FloatArray
    stayed: np.ndarray


def make_model(name: str) -> NLARX | DuffingODE:
    """The estimator's model of a population in `MODELS`. The paper's pairs u_t with the output that it leads to."""
    if name == "ode":
        return DuffingODE()
    return NLARX(input_delay=0) if name == "paper" else NLARX(regressors=name)


def make_prior(name: str, process_noise: float, measurement_noise: float, noise_shape: float) -> Prior | JointBelief:
    """The prior with the moments of the population `draw` draws from, and Gamma priors centred at the given noises."""
    if name == "paper":
        return Prior.silverbox_twin(SPREAD, process_noise, measurement_noise, noise_shape)
    if name == "ode":
        weak = DuffingODE().prior(SPREAD, process_noise, measurement_noise, noise_shape)
        width = np.log((1 + SPREAD) / (1 - SPREAD))
        mean = 2 * SPREAD / width  # of a value over the twin's
        mean_square = 2 * SPREAD / width  # half of (1 + s)² - (1 - s)², over the width
        scale = np.ones(N_JOINT)
        scale[N_STATES : N_STATES + 4] = np.sqrt(mean_square - mean**2) / SPREAD
        std = scale * np.sqrt(np.diag(weak.cov))
        std[:N_STATES] = STATE_STD, STATE_STD / SAMPLING_STEP
        means = weak.mean.copy()
        means[N_STATES : N_STATES + 4] *= mean
        return replace(weak, mean=means, cov=np.diag(std**2))
    weak = NLARX(regressors=name).prior(SPREAD, process_noise, measurement_noise, noise_shape)
    terms = PRESETS[name]
    mean, cov = weak.mean.copy(), np.diag([STATE_STD**2] * 2 + [_std(term) ** 2 for term in terms])
    places = [2 + terms.index(term) for term in _FOUR]
    mean[places], cov[np.ix_(places, places)] = log_uniform_moments(SILVERBOX_TWIN, SPREAD)
    return replace(weak, mean=mean, cov=cov)


def _std(term: Term) -> float:
    return _OTHERS.get(term, _PRODUCT)


def draw(
    name: str, systems: int, process_noise: float, measurement_noise: float, samples: int, rng: np.random.Generator
) -> Systems:
    """Draw systems of a population and simulate them.

    Args:
        name: one of `MODELS`. ``paper`` and the presets: m, c, a and b are log-uniform, the other coefficients normal
            (offset 2 mV, further taps 0.05, further products 0.1 V⁻¹ or V⁻²). ``ode``: stiffness, damping, gain and
            cubic stiffness are log-uniform, offsets and feedthrough as `DuffingODE.prior` has them.
        systems: their number N.
        process_noise: standard deviation of what the process noise of a sample does to the displacement [V].
        measurement_noise: standard deviation of v [V].
        samples: number of samples T.
        rng: draws systems, inputs and noises.
    """
    factors = np.exp(rng.uniform(np.log(1 - SPREAD), np.log(1 + SPREAD), (systems, 4)))
    if name == "ode":
        std = np.sqrt(np.diag(DuffingODE().prior().coefficients_cov))
        truth = DuffingODE().prior().coefficients_mean * np.ones((systems, 1))
        truth[:, :4] *= factors
        truth[:, _OFFSETS] = std[list(_OFFSETS)] * rng.standard_normal((systems, 3))
        return Systems(DuffingODE.names, truth, *simulate_ode(truth, process_noise, measurement_noise, samples, rng))
    twin = np.array([SILVERBOX_TWIN.m, SILVERBOX_TWIN.c, SILVERBOX_TWIN.a, SILVERBOX_TWIN.b])
    physical = twin * factors
    psi = to_coefficients(PhysicalParameters(*physical.T))
    four = dict(zip(_FOUR, (psi.theta1, psi.theta2, psi.theta3, psi.eta), strict=True))
    terms = PRESETS[name]
    coefficients = np.column_stack(
        [four[term] if term in four else _std(term) * rng.standard_normal(systems) for term in terms]
    )
    if name == "paper":
        terms = (*terms[:-1], Term(tap=0))
    records = simulate(terms, coefficients, process_noise, measurement_noise, samples, rng)
    if name == "paper":
        names = ("θ1", "θ2", "θ3", "η", "m", "c", "a", "b")
        return Systems(names, np.column_stack([coefficients, physical]), *records)
    return Systems(tuple(term.name for term in terms), coefficients, *records)


def simulate(
    terms: tuple[Term, ...],
    coefficients: FloatArray,
    process_noise: float,
    measurement_noise: float,
    samples: int,
    rng: np.random.Generator,
) -> tuple[FloatArray, FloatArray, np.ndarray]:
    """Simulate difference equations with coefficients (N, K), each with its own input: u, y (N, T) and stayed (N,)."""
    shape = (len(coefficients), samples)
    u, w, y = _inputs_and_noises(shape, process_noise, measurement_noise, rng)
    stayed = np.ones(shape[0], dtype=bool)
    x = x_last = np.zeros(shape[0])
    for t in range(samples):
        total = np.zeros(shape[0])
        for term, c in zip(terms, coefficients.T, strict=True):
            tap = term.tap
            drive = 1.0 if tap is None else u[:, t - tap] if t >= tap else 0.0
            total = total + c * (x**term.lag1 * x_last**term.lag2 * drive)
        x, x_last = total + w[:, t], x
        stayed &= np.abs(x) < MAX_DISPLACEMENT
        x = np.where(stayed, x, 0.0)  # so that those that left do not overflow
        y[:, t] += x
    return u, y, stayed


def simulate_ode(
    parameters: FloatArray, process_noise: float, measurement_noise: float, samples: int, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray, np.ndarray]:
    """Simulate the physical equation with parameters (N, 8) and an input that is linear between samples.

    It starts at random, with the standard deviations of the prior. Returns as `simulate`; its cubic stiffness hardens,
    so that all systems stay.
    """
    model = DuffingODE()
    shape = (len(parameters), samples)
    u, w, y = _inputs_and_noises(shape, process_noise, measurement_noise, rng)
    starts = rng.standard_normal((len(parameters), N_STATES)) * [STATE_STD, STATE_STD / SAMPLING_STEP]
    for i, truth in enumerate(parameters):
        coordinates = to_coordinates(np.concatenate([starts[i], truth]), np.zeros((N_JOINT, N_JOINT)))[0]
        z = np.empty(samples)
        move(coordinates[:N_MOTION], model.pieces(u[i]), w[i], model.substeps, z)
        y[i] += z + truth[-1] * u[i]
    return u, y, np.ones(shape[0], dtype=bool)


def _inputs_and_noises(
    shape: tuple[int, int], process_noise: float, measurement_noise: float, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray, FloatArray]:
    u = rng.uniform(-MAX_INPUT, MAX_INPUT, shape)
    return u, process_noise * rng.standard_normal(shape), measurement_noise * rng.standard_normal(shape)


@kernel
def move(start, pieces, w, substeps, z):
    """Displacements with offset (T,) of the physical equation, into ``z``.

    Args:
        start: (N_MOTION,) the state (z, z') and the parameters, in the coordinates of `to_coordinates`.
        pieces: (T - 1, degree + 1) the input on the way from each sample to the next.
        w: (T,) process noise: an acceleration held over the sample, by which it moves z [V].
        substeps: Runge-Kutta steps per sample.
        z: (T,) receives the displacements [V].
    """
    sensitivities = np.empty((N_STATES, N_MOTION))
    work = np.empty((3, N_STATES, N_MOTION))
    position, velocity = start[0], start[1]
    for t in range(len(z)):
        if t > 0:
            position, velocity = flow(
                position, velocity, start[N_STATES:], pieces[t - 1], substeps, sensitivities, work
            )  # fmt: skip
        position += w[t]
        velocity += 2.0 * w[t]
        z[t] = position
