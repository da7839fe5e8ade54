"""Plain NumPy twins of `DuffingEnv` and `ContinuousEnv`: steps written from the paper and the docstrings.

They share no code with the kernel, and know nothing of the engine that generates it: of the package they use the
priors and the twins of the circuit.
"""

from dataclasses import replace
from functools import cache

import numpy as np
import reference.mean_field
from reference.filters import continuous_step, difference_step, moved, oscillator, predicted, runge_kutta, seen
from reference.mean_field import LOG_2PI, mean_field_step
from reference.structured import structured_update
from rounding import U32

from estimator import SILVERBOX_ODE_TWIN, SILVERBOX_SAMPLING_STEP, SILVERBOX_TWIN, Parameters
from estimator.models.difference_equation import difference
from estimator.models.duffing import duffing
from estimator.priors import log_uniform_moments, weak_prior

#: An observation is rounded to float32; what is rounded agrees to 1e-9 of a belief's units, see `assert_beliefs_agree`.
ROUNDED = {"rtol": 2 * U32, "atol": 1e-8}
PARAMETERS = ("m", "c", "a", "b")
ITERATIONS = {"structured": 3, "mean_field": 10}


class Moments(reference.mean_field.Moments):
    """A belief over two states and four coefficients."""

    @classmethod
    def of(cls, belief):
        return cls(belief.mean, belief.cov, tuple(belief.noises[:2]), tuple(belief.noises[2:]))

    @classmethod
    def like(cls, moments):
        """The same for other moments."""
        return cls(moments.mean, moments.cov, moments.gamma, moments.xi)

    @property
    def coefficients(self):
        """Mean (4,) and covariance (4, 4)."""
        return self.mean[2:], self.cov[2:, 2:]

    def entropy(self):
        """Of the coefficients [nats]."""
        return entropy(self.cov[2:, 2:])

    def log_prob(self, coefficients):
        """Log density of the coefficients [nats]."""
        mean, cov = self.coefficients
        return log_normal(coefficients - mean, cov)


def to_coefficients(truth):
    """(4,) θ1, θ2, θ3 and η of an oscillator, Eqs. (3) and (4)."""
    m, c, a, b = (getattr(truth, name) for name in PARAMETERS)
    d = SILVERBOX_SAMPLING_STEP
    return np.array([2 * m + c * d - a * d**2, -b * d**2, -m, d**2]) / (m + c * d)


def to_parameters(coefficients):
    """(4,) m, c, a and b of them."""
    t1, t2, t3, e = coefficients
    return np.array([-t3 * SILVERBOX_SAMPLING_STEP**2, (1 + t3) * SILVERBOX_SAMPLING_STEP, 1 - t1 - t3, -t2]) / e


def to_rates(truth):
    """(4,) stiffness, cubic, damping and gain of an oscillator, with time counted in samples."""
    m, c, a, b = (getattr(truth, name) for name in PARAMETERS)
    return np.array([a, b, c / SILVERBOX_SAMPLING_STEP, 1.0]) * SILVERBOX_SAMPLING_STEP**2 / m


def from_rates(coefficients):
    """(4,) m, c, a and b of them."""
    stiffness, cubic, damping, gain = coefficients
    return np.array([SILVERBOX_SAMPLING_STEP**2, SILVERBOX_SAMPLING_STEP * damping, stiffness, cubic]) / gain


def log_det(cov):
    """log det of a covariance, from its correlations, which are better conditioned."""
    std = np.sqrt(np.diag(cov))
    return np.linalg.slogdet(cov / np.outer(std, std))[1] + 2 * np.log(std).sum()


def entropy(cov):
    """Of a Gaussian [nats]."""
    return 0.5 * (len(cov) * (LOG_2PI + 1) + log_det(cov))


def log_normal(deviation, cov):
    """Log density of a Gaussian."""
    return -0.5 * (len(cov) * LOG_2PI + log_det(cov) + deviation @ np.linalg.solve(cov, deviation))


@cache
def multisine():
    """The input of a free run in parts of the largest: 20 harmonics over 64 samples, Schroeder's phases, peak ½."""
    waves = np.zeros(64)
    for k in range(1, 21):
        waves += np.cos(2 * np.pi * k * np.arange(64) / 64 - np.pi * k * (k - 1) / 20)
    return 0.5 * waves / np.abs(waves).max()


def misfit(believed, true):
    """Error of a free run beside the true one, relative to its size, capped."""
    with np.errstate(all="ignore"):
        error = np.sqrt(((believed - true) ** 2).sum() / (true**2).sum())
    return error if error < 1.0 else 1.0


class Stream:
    """The random numbers of one environment: NumPy's SFC64, seeded with 128 bits from the seed's `np_random`."""

    def __init__(self, seed):
        entropy = np.random.default_rng(seed).integers(0, 2**32, size=4, dtype=np.uint32)
        self._bits = np.random.SFC64(np.random.SeedSequence(entropy.tolist()))

    def uniform(self):
        """A number in (0, 1): the middle of one of 2^52 equal intervals."""
        return (float(self._bits.random_raw() >> 12) + 0.5) / 2.0**52

    def normal_pair(self):
        """Two standard normal numbers, by Box and Muller."""
        radius = np.sqrt(-2.0 * np.log(self.uniform()))
        angle = 2.0 * np.pi * self.uniform()
        return radius * np.cos(angle), radius * np.sin(angle)


class TwinEnv:
    """One experiment. `reset` and `step` follow Gymnasium, but a step returns every reward by its name."""

    center, model = SILVERBOX_TWIN, difference()
    runs_freely = False  # whether there is a reward "simulation_error", which takes time
    to_coefficients, to_parameters = staticmethod(to_coefficients), staticmethod(to_parameters)

    def __init__(
        self,
        seed,
        *,
        factorisation="structured",
        iterations=None,
        horizon=256,
        max_input=0.15,
        max_output=0.6,
        process_noise=5e-4,
        measurement_noise=5e-4,
        spread=0.3,
        noise_range=1.0,
        process_noise_guess=None,
        measurement_noise_guess=None,
        max_rms=np.inf,
        max_slew=np.inf,
        input_cost=0.0,
        jump=0.0,
        drift=0.0,
    ):
        self.stream = Stream(seed)
        self.factorisation, self.iterations = factorisation, iterations or ITERATIONS[factorisation]
        self.horizon, self.max_input, self.max_output = horizon, max_input, max_output
        self.process_noise, self.measurement_noise, self.spread = process_noise, measurement_noise, spread
        self.budget, self.max_slew, self.input_cost = horizon * max_rms**2, max_slew, input_cost
        self.jump, self.drift = jump, drift
        self.noise_range, self.noise_centers = noise_range, (process_noise, measurement_noise)
        center = {name: getattr(self.center, name) for name in PARAMETERS}
        moments = log_uniform_moments(self.model, center, spread)
        guesses = process_noise_guess or process_noise, measurement_noise_guess or measurement_noise
        prior = weak_prior(self.model, *moments, *guesses).with_factorisation(factorisation)
        self.first_belief = Moments.of(prior)

    def reset(self):
        """Draw an oscillator, put it at rest, and return the first observation."""
        low, high = 1.0 - self.spread, 1.0 + self.spread
        factors = [low * (high / low) ** self.stream.uniform() for _ in PARAMETERS]
        drawn = [getattr(self.center, name) * f for name, f in zip(PARAMETERS, factors, strict=True)]
        self.truth = Parameters(zip(PARAMETERS, drawn, strict=True))
        if self.noise_range > 1:
            powers = [self.stream.uniform() - 0.5 for _ in self.noise_centers]
            noises = [std * self.noise_range**p for std, p in zip(self.noise_centers, powers, strict=True)]
            self.process_noise, self.measurement_noise = noises
        self.state = np.zeros(2)
        self.u = self.last_u = self.y = self.spent = 0.0
        self.elapsed = 0
        if self.jump:
            self.jump_at = int(self.horizon * (0.25 + 0.5 * self.stream.uniform()))
            self.jump_factor = (1.0 - self.jump) * ((1.0 + self.jump) / (1.0 - self.jump)) ** self.stream.uniform()
        self.belief = self.first_belief
        self.ideal_cov = self.first_belief.cov  # with the true parameters
        self._worth = self._appraise()
        return self.observation()

    def step(self, action):
        """Apply one action (1,): the observation, all rewards, and the two flags."""
        asked = self.max_input * float(np.clip(np.float32(action[0]), -1.0, 1.0))
        self.last_u = self.u
        self.u += np.clip(asked - self.u, -self.max_slew, self.max_slew)
        left = np.sqrt(max(self.budget - self.spent, 0.0))
        self.u = float(np.clip(self.u, -left, left))
        self.spent += self.u**2
        if self.jump and self.elapsed == self.jump_at:
            self.truth = Parameters({**self.truth, "m": self.truth.m * self.jump_factor})
            self._worth = self._appraise()
        fisher = self._fisher_gain()
        self._move()
        walk = (self.drift * np.sqrt(np.diag(self.first_belief.cov))) ** 2 * [0, 0, 1, 1, 1, 1]
        self.belief = replace(self.belief, cov=self.belief.cov + np.diag(walk))
        expected = self._expected_gain()
        self._update()
        self.elapsed += 1
        before, self._worth = self._worth, self._appraise()
        rewards = {name: self._worth[name] - before[name] for name in before}
        rewards["free_energy"] = -self.free_energy
        rewards["fisher"] = fisher
        rewards["expected_free_energy"] = expected
        self.reported = dict(rewards)
        cost = self.input_cost * (self.u / self.max_input) ** 2
        rewards = {name: reward - cost for name, reward in rewards.items()}
        terminated = abs(self.y) > self.max_output
        return self.observation(), rewards, terminated, self.elapsed == self.horizon and not terminated

    def _move(self):
        w, v = self.stream.normal_pair()
        moved, _, _ = difference_step([*self.state, *to_coefficients(self.truth)], self.u)
        self.state = moved + self.process_noise * np.array([w, 0.0])
        self.y = self.state[0] + self.measurement_noise * v

    def _model_step(self, mean):
        """The model's step from a mean, under the input of this sample."""
        return difference_step(mean, self.u)

    def _update(self):
        if self.factorisation == "mean_field":
            self.belief, energies = mean_field_step(self.belief, self.u, self.y, self.iterations, evaluated=1)
            self.belief, self.free_energy = Moments.like(self.belief), energies[-1]
        else:
            step = self._model_step(self.belief.mean)
            self.belief, self.free_energy = structured_update(self.belief, step, self.y, self.iterations)

    def _fisher_gain(self):
        """Increase of ½ log det(Λ0 + F): a Kalman filter for states and coefficients, linearised at the truth."""
        step = self._model_step(np.array([*self.state, *self.to_coefficients(self.truth)]))
        before = self.ideal_cov
        self.ideal_cov = seen(predicted(before, step, self.process_noise**2), self.measurement_noise**2).cov
        return 0.5 * (log_det(before[2:, 2:]) - log_det(self.ideal_cov[2:, 2:]))

    def _expected_gain(self):
        """Decrease of ½ log det C by an output of any value: a Kalman step with the believed noises."""
        belief = self.belief
        cov = predicted(belief.cov, self._model_step(belief.mean), belief.gamma[1] / belief.gamma[0])
        after = seen(cov, belief.xi[1] / belief.xi[0]).cov
        return 0.5 * (log_det(cov[2:, 2:]) - log_det(after[2:, 2:]))

    def free_run(self, coefficients):
        """x (64,) of the model alone, from rest under the test input."""
        t1, t2, t3, e = (float(c) for c in coefficients)
        x = last_x = 0.0
        values = []
        for u in (self.max_input * multisine()).tolist():
            x, last_x = t1 * x + t2 * x * x * x + t3 * last_x + e * u, x
            values.append(x)
        return np.array(values)

    def _appraise(self):
        """The level of every reward that is a difference: a step's reward is its increase."""
        mean, true = self.belief.mean[2:], self.to_coefficients(self.truth)
        truth = np.array([getattr(self.truth, name) for name in PARAMETERS])
        worth = {
            "information_gain": -self.belief.entropy(),
            "log_posterior": self.belief.log_prob(true),
            "parameter_error": -np.minimum(np.abs(self.to_parameters(mean) / truth - 1.0), 1.0).mean(),
        }
        if self.runs_freely:
            worth["simulation_error"] = -misfit(self.free_run(mean), self.free_run(true))
        return worth

    def observation(self):
        """The table of the environment's docstring, row by row."""
        belief, first = self.belief, self.first_belief
        (mean, cov), (first_mean, first_cov) = belief.coefficients, first.coefficients
        std, first_std = np.sqrt(np.diag(cov)), np.sqrt(np.diag(first_cov))
        correlations = (cov / np.outer(std, std))[np.triu_indices(4, k=1)]
        precisions = [b.gamma[0] / b.gamma[1] for b in (belief, first)], [b.xi[0] / b.xi[1] for b in (belief, first)]
        return np.concatenate(
            [
                np.clip((mean - first_mean) / first_std, -10, 10),
                np.clip(np.log(std / first_std), -20, 5),
                correlations,
                np.log([now / then for now, then in precisions]),
                np.clip(belief.mean[:2] / self.max_output, -2, 2),
                [self.u / self.max_input, np.clip(self.y / self.max_output, -2, 2)],
                [1.0 - self.elapsed / self.horizon, 1.0 - self.spent / self.budget],
            ]
        )


class TwinContinuousEnv(TwinEnv):
    """One experiment on the differential equation, from the docstring of `ContinuousEnv`."""

    center = SILVERBOX_ODE_TWIN

    def __init__(self, seed, *, estimator="ode", **options):
        self.estimator = estimator
        if estimator == "ode":
            self.model, self.to_coefficients, self.to_parameters = duffing(), to_rates, from_rates
        super().__init__(seed, **options)

    def _model_step(self, mean):
        if self.estimator == "ode":
            return continuous_step(mean, self.u, self.u)
        return difference_step(mean, self.u)

    def _fisher_gain(self):
        # Refused where the estimator has another equation than the plant.
        return super()._fisher_gain() if self.estimator == "ode" else np.nan

    def free_run(self, coefficients):
        """x (64,) of the model alone, from rest under the test input."""
        if self.estimator != "ode":
            return super().free_run(coefficients)
        state, values = np.zeros(2), []
        with np.errstate(all="ignore"):
            for u in self.max_input * multisine():
                state = moved(oscillator(), state, coefficients, (u,))
                values.append(state[0])
        return np.array(values)

    def _move(self):
        # A pair of numbers for each of eight sub-steps, and one for the sensor.
        h = 1 / 8
        rates, plant, state = to_rates(self.truth), oscillator(), self.state
        # Increments of a Wiener process and of its integral, which moves x by `process_noise` in a sample.
        spread = np.linalg.cholesky(np.array([[h, h**2 / 2], [h**2 / 2, h**3 / 3]]))
        for _ in range(8):
            increments = np.sqrt(3) * self.process_noise * spread @ self.stream.normal_pair()
            state = runge_kutta(lambda z, _: h * np.array(plant.move(z, rates, self.u)), state) + increments[::-1]
        self.state = state
        self.y = self.state[0] + self.measurement_noise * self.stream.normal_pair()[1]


def assert_beliefs_agree(actual, expected):
    """Compare beliefs to rounding: coefficients relative to their standard deviations, the state relative to 1 V."""
    mean, cov = expected.coefficients
    std = np.sqrt(np.diag(cov))
    np.testing.assert_allclose(actual.coefficients_mean / std, mean / std, rtol=0, atol=1e-9)
    np.testing.assert_allclose(actual.state_mean, expected.mean[:2], rtol=0, atol=1e-10)
    scale = np.outer(std, std)
    np.testing.assert_allclose(actual.coefficients_cov / scale, cov / scale, rtol=0, atol=1e-9)
    np.testing.assert_allclose(actual.noises, [*expected.gamma, *expected.xi], rtol=1e-9)


def assert_env_follows_twin(env, twin, reward, seed, episodes=2):
    """Play random inputs, some beyond the limits; return the flags with which the episodes ended."""
    twin.runs_freely = reward == "simulation_error"
    rng = np.random.default_rng(seed)
    endings = []
    for episode in range(episodes):
        observation, _ = env.reset(seed=None if episode else seed)
        np.testing.assert_allclose(observation, twin.reset(), **ROUNDED)
        for name in PARAMETERS:
            np.testing.assert_allclose(getattr(env.truth, name), getattr(twin.truth, name), rtol=1e-14)
        if twin.noise_range > 1:
            values = env.truth.process_noise, env.truth.measurement_noise
            np.testing.assert_allclose(values, (twin.process_noise, twin.measurement_noise), rtol=1e-14)
        terminated = truncated = False
        while not (terminated or truncated):
            action = rng.uniform(-1.2, 1.2, 1).astype(np.float32)
            observation, received, terminated, truncated, info = env.step(action)
            expected, rewards, *flags = twin.step(action)
            np.testing.assert_allclose(observation, expected, **ROUNDED)
            np.testing.assert_allclose(received, rewards[reward], rtol=1e-9, atol=1e-9)
            gains = (twin.reported["information_gain"], twin.reported["log_posterior"])
            values = (info["information_gain"], info["log_posterior_gain"])
            np.testing.assert_allclose(values, gains, rtol=1e-9, atol=1e-9)
            assert [terminated, truncated] == flags
            assert not info["diverged"]
        assert_beliefs_agree(env.belief, twin.belief)
        endings.append((terminated, truncated))
    return endings
