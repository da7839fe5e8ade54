"""Plain NumPy twins of `DuffingEnv` and `ContinuousEnv`: steps written from the paper and the docstrings.

They share no code with the kernel but the estimators, which have twins of its own under tests/estimator.
"""

from dataclasses import replace

import numpy as np
import pytest
from rounding import U32

from duffing_env.rewards import REWARDS
from estimator import (
    CONTINUOUS_TWIN,
    NLARX,
    SAMPLING_STEP,
    SILVERBOX_TWIN,
    ContinuousBelief,
    OnlineEstimator,
    PhysicalParameters,
    Prior,
    continuous_prior,
    to_coefficients,
)
from estimator.inference import continuous, free_energy
from estimator.lanes import LANES
from estimator.record import LAYOUT, N_ROWS, RECORD

PARAMETERS = ("m", "c", "a", "b")
JOINT = ("x0", "x1", "t1", "t2", "t3", "e")
#: An observation is rounded to float32; what is rounded agrees to 1e-9 of a belief's units, see `assert_beliefs_agree`.
ROUNDED = {"rtol": 2 * U32, "atol": 1e-8}
#: Every factorisation beside every reward. Three rewards read of a mean-field belief what they read of another: their
#: kernels, each of which is seconds of compilation, are left to the evidence.
PAIRS = [
    pytest.param(
        factorisation,
        reward,
        marks=[pytest.mark.slow]
        * (factorisation == "mean_field" and reward in ("fisher", "expected_free_energy", "simulation_error")),
    )
    for factorisation in ("structured", "mean_field")
    for reward in REWARDS
]


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


def joint_moments(belief):
    """Means (6,) and covariance (6, 6) of x_t, x_{t-1}, θ, η from the record."""
    told = dict(zip(RECORD, belief.record, strict=True))
    cov = [[told.get(f"P_{a}_{b}", told.get(f"P_{b}_{a}")) for b in JOINT] for a in JOINT]
    return np.array([told[name] for name in JOINT]), np.array(cov)


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
        max_rms=np.inf,
        max_slew=np.inf,
        input_cost=0.0,
        jump=0.0,
        drift=0.0,
    ):
        self.stream = Stream(seed)
        self.factorisation, self.iterations = factorisation, iterations
        self.horizon, self.max_input, self.max_output = horizon, max_input, max_output
        self.process_noise, self.measurement_noise, self.spread = process_noise, measurement_noise, spread
        self.budget, self.max_slew, self.input_cost = horizon * max_rms**2, max_slew, input_cost
        self.jump, self.drift = jump, drift
        self.prior = Prior.silverbox_twin(spread, process_noise, measurement_noise)
        self.center = SILVERBOX_TWIN

    def reset(self):
        """Draw an oscillator, put it at rest, and return the first observation."""
        low, high = 1.0 - self.spread, 1.0 + self.spread
        factors = [low * (high / low) ** self.stream.uniform() for _ in PARAMETERS]
        drawn = [getattr(self.center, name) * f for name, f in zip(PARAMETERS, factors, strict=True)]
        self.truth = PhysicalParameters(*drawn)
        self.x = self.last_x = self.u = self.y = self.spent = 0.0
        self.elapsed = 0
        if self.jump:
            self.jump_at = int(self.horizon * (0.25 + 0.5 * self.stream.uniform()))
            self.jump_factor = (1.0 - self.jump) * ((1.0 + self.jump) / (1.0 - self.jump)) ** self.stream.uniform()
        self._start()
        self.first_belief = self.belief
        self.ideal_cov = np.zeros((6, 6))  # of (x_t, x_{t-1}, θ, η), for one who knows the truth
        self.ideal_cov[:2, :2] = self.first_belief.state_cov[:2, :2]
        self.ideal_cov[2:, 2:] = self.first_belief.coefficients_cov
        self._worth = self._appraise()
        return self.observation()

    def _start(self):
        self._know()
        self.estimator = OnlineEstimator(
            NLARX(input_delay=0), self.prior, self.factorisation, self.iterations, drift=self.drift
        )

    def _know(self):
        self.coefficients = to_coefficients(self.truth)

    @property
    def belief(self):
        return self.estimator.belief

    def step(self, action):
        """Apply one action (1,): the observation, all rewards, and the two flags."""
        asked = self.max_input * float(np.clip(np.float32(action[0]), -1.0, 1.0))
        self.u += np.clip(asked - self.u, -self.max_slew, self.max_slew)
        left = np.sqrt(max(self.budget - self.spent, 0.0))
        self.u = float(np.clip(self.u, -left, left))
        self.spent += self.u**2
        if self.jump and self.elapsed == self.jump_at:
            self.truth = replace(self.truth, m=self.truth.m * self.jump_factor)
            self._know()
            self._worth = self._appraise()
        fisher, expected = self._fisher_gain(), self._expected_gain()
        self._move()
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
        psi = self.coefficients
        moved = psi.theta1 * self.x + psi.theta2 * self.x**3 + psi.theta3 * self.last_x + psi.eta * self.u
        self.x, self.last_x = moved + self.process_noise * w, self.x
        self.y = self.x + self.measurement_noise * v

    def _update(self):
        self.estimator.update(self.u, self.y)
        self.free_energy = self.estimator.free_energy

    def _fisher_gain(self):
        """Increase of ½ log det(Λ0 + F): a Kalman filter for states and coefficients, linearised at the truth."""
        psi, x, last_x = self.coefficients, self.x, self.last_x
        jacobian = np.eye(6)
        jacobian[0] = [psi.theta1 + 3 * psi.theta2 * x**2, psi.theta3, x, x**3, last_x, self.u]
        jacobian[1] = [1, 0, 0, 0, 0, 0]
        cov = jacobian @ self.ideal_cov @ jacobian.T
        cov[0, 0] += self.process_noise**2
        gain = cov[:, 0] / (cov[0, 0] + self.measurement_noise**2)
        before, self.ideal_cov = self.ideal_cov, cov - np.outer(gain, cov[0])
        return 0.5 * (np.linalg.slogdet(before[2:, 2:])[1] - np.linalg.slogdet(self.ideal_cov[2:, 2:])[1])

    def _expected_gain(self):
        """½ log det C less that after an output, whatever it is: a Kalman step with the noises as believed."""
        belief = self.belief
        (x, last_x, t1, t2, t3, _), cov = joint_moments(belief)
        first_std = np.sqrt(np.diag(self.first_belief.coefficients_cov))
        cov[2:, 2:] += np.diag((self.drift * first_std) ** 2)
        direction = np.array([t1 + 3 * t2 * x**2, t3, x, x**3, last_x, self._input_of_the_model()])
        c = cov @ direction
        variance = direction @ c + 1 / belief.gamma_mean + 1 / belief.xi_mean
        before, after = cov[2:, 2:], cov[2:, 2:] - np.outer(c[2:], c[2:]) / variance
        scale = np.sqrt(np.outer(np.diag(before), np.diag(before)))
        return 0.5 * (np.linalg.slogdet(before / scale)[1] - np.linalg.slogdet(after / scale)[1])

    def _input_of_the_model(self):
        return self.u

    def _free_run(self, coefficients):
        """x (64,) of the difference equation from rest under the test input."""
        t1, t2, t3, e = np.float64(coefficients)
        x, last_x, told = np.zeros(1), np.zeros(1), []
        with np.errstate(all="ignore"):  # one that runs away
            for u in self.max_input * multisine():
                x, last_x = t1 * x + t2 * x**3 + t3 * last_x + e * u, x
                told.append(x)
        return np.concatenate(told)

    def _true_coefficients(self):
        psi = self.coefficients
        return [psi.theta1, psi.theta2, psi.theta3, psi.eta]

    def _appraise(self):
        """What the belief is worth by each reward that is a difference: a step's reward is its increase."""
        mean, _ = self.belief.physical()
        truth = np.array([getattr(self.truth, name) for name in PARAMETERS])
        return {
            "information_gain": -self.belief.entropy(),
            "log_posterior": self.belief.log_prob(self.coefficients),
            "parameter_error": -np.minimum(np.abs(mean / truth - 1.0), 1.0).mean(),
            "simulation_error": -misfit(
                self._free_run(self.belief.coefficients_mean), self._free_run(self._true_coefficients())
            ),
        }

    def observation(self):
        """The table of the environment's docstring, row by row."""
        belief, first = self.belief, self.first_belief
        std, first_std = (np.sqrt(np.diag(b.coefficients_cov)) for b in (belief, first))
        correlations = (belief.coefficients_cov / np.outer(std, std))[np.triu_indices(4, k=1)]
        return np.concatenate(
            [
                np.clip((belief.coefficients_mean - first.coefficients_mean) / first_std, -10, 10),
                np.clip(np.log(std / first_std), -20, 5),
                correlations,
                np.log([belief.gamma_mean / first.gamma_mean, belief.xi_mean / first.xi_mean]),
                np.clip(belief.state_mean[:2] / self.max_output, -2, 2),
                [self.u / self.max_input, np.clip(self.y / self.max_output, -2, 2)],
                [1.0 - self.elapsed / self.horizon, 1.0 - self.spent / self.budget],
            ]
        )


class TwinContinuousEnv(TwinEnv):
    """One experiment on the differential equation, from the docstring of `ContinuousEnv`."""

    def __init__(self, seed, *, estimator="ode", **options):
        super().__init__(seed, **options)
        self.kind = estimator
        noises = self.process_noise, self.measurement_noise
        if estimator == "ode":
            self.prior = continuous_prior(CONTINUOUS_TWIN, self.spread, *noises)
        else:
            self.prior = Prior.silverbox_twin(self.spread, *noises, center=CONTINUOUS_TWIN)
        self.center = CONTINUOUS_TWIN

    def _start(self):
        self.velocity = self.last_u = 0.0
        if self.kind != "ode":
            super()._start()
            return
        self._know()
        self.block = np.zeros((N_ROWS, LANES))
        self.block[: len(self.prior.record)] = self.prior.record[:, None]

    def _know(self):
        super()._know()
        if self.kind == "ode":
            m, c, a, b = (getattr(self.truth, name) for name in PARAMETERS)
            # Time in samples.
            self.coefficients = np.array([a, b, c / SAMPLING_STEP, 1.0]) * SAMPLING_STEP**2 / m

    def _fisher_gain(self):
        return np.nan  # refused on this plant

    def _input_of_the_model(self):
        return self.last_u

    def _expected_gain(self):
        if self.kind != "ode":
            return super()._expected_gain()
        # Where the noises are known, what an update gives does not depend on the output.
        block, before = self.block.copy(), self.belief.entropy()
        for name in ("g_shape", "g_rate", "n_shape", "n_rate"):
            block[LAYOUT[name]] *= 1e12
        for name, value in (("last_u", self.last_u), ("u", self.u), ("y", 0.0)):
            block[LAYOUT[name]] = value
        continuous.update(block.reshape(-1), 1, continuous.SUBSTEPS)
        return before - ContinuousBelief(block[: len(self.prior.record), 0]).entropy()

    def _free_run(self, coefficients):
        if self.kind != "ode":
            return super()._free_run(coefficients)
        stiffness, cubic, damping, gain = coefficients
        state, told, last_u, h = np.zeros(2), [], 0.0, 0.5
        for u in self.max_input * multisine():

            def slope(tau, state, begin=last_u, end=u):
                x, v = state
                return np.array([v, gain * (begin + tau * (end - begin)) - stiffness * x - cubic * x**3 - damping * v])

            for tau in (0.0, h):
                k1 = slope(tau, state)
                k2 = slope(tau + h / 2, state + h / 2 * k1)
                k3 = slope(tau + h / 2, state + h / 2 * k2)
                k4 = slope(tau + h, state + h * k3)
                state = state + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
                told.append(state[0])
            last_u = u
        return np.array(told)

    def _true_coefficients(self):
        return self.coefficients if self.kind == "ode" else super()._true_coefficients()

    @property
    def belief(self):
        return ContinuousBelief(self.block[: len(self.prior.record), 0]) if self.kind == "ode" else super().belief

    def _move(self):
        # A pair of numbers for each of eight sub-steps, and one for the sensor.
        m, c, a, b = (getattr(self.truth, name) for name in PARAMETERS)
        h = 1 / 8

        def slope(tau, state):
            force = self.last_u + tau * (self.u - self.last_u) - a * state[0] - b * state[0] ** 3
            force -= c * state[1] / SAMPLING_STEP
            return np.array([state[1], force * SAMPLING_STEP**2 / m])

        state = np.array([self.x, self.velocity])
        # Increments of a Wiener process and of its integral, which moves x by `process_noise` in a sample.
        spread = np.linalg.cholesky(np.array([[h, h**2 / 2], [h**2 / 2, h**3 / 3]]))
        for s in range(8):
            k1 = slope(s * h, state)
            k2 = slope((s + 0.5) * h, state + h / 2 * k1)
            k3 = slope((s + 0.5) * h, state + h / 2 * k2)
            k4 = slope((s + 1) * h, state + h * k3)
            increments = np.sqrt(3) * self.process_noise * spread @ self.stream.normal_pair()
            state = state + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4) + increments[::-1]
        self.x, self.velocity = state
        self.y = self.x + self.measurement_noise * self.stream.normal_pair()[1]

    def _update(self):
        if self.kind == "ode":
            for name, value in (("last_u", self.last_u), ("u", self.u), ("y", self.y)):
                self.block[LAYOUT[name]] = value
            continuous.update(self.block.reshape(-1), self.iterations or 3, continuous.SUBSTEPS)
            self.free_energy = free_energy(self.block.reshape(-1), 0, True)
        else:
            self.estimator.update(self.last_u, self.y)  # the input at x_t, as in Eq. (2)
            self.free_energy = self.estimator.free_energy
        self.last_u = self.u


def assert_beliefs_agree(actual, expected):
    """To rounding: the coefficients beside their standard deviations, the state beside a volt."""
    std = np.sqrt(np.diag(expected.coefficients_cov))
    np.testing.assert_allclose(actual.coefficients_mean / std, expected.coefficients_mean / std, rtol=0, atol=1e-9)
    np.testing.assert_allclose(actual.state_mean, expected.state_mean, rtol=0, atol=1e-10)
    scale = np.outer(std, std)
    np.testing.assert_allclose(actual.coefficients_cov / scale, expected.coefficients_cov / scale, rtol=0, atol=1e-10)
    for name in ("gamma_shape", "gamma_rate", "xi_shape", "xi_rate"):
        np.testing.assert_allclose(getattr(actual, name), getattr(expected, name), rtol=1e-10)


def assert_env_follows_twin(env, twin, reward, seed, episodes=2):
    """Play random inputs, some beyond the limits; gives the flags with which the episodes ended."""
    rng = np.random.default_rng(seed)
    endings = []
    for episode in range(episodes):
        observation, _ = env.reset(seed=None if episode else seed)
        np.testing.assert_allclose(observation, twin.reset(), **ROUNDED)
        for name in PARAMETERS:
            np.testing.assert_allclose(getattr(env.truth, name), getattr(twin.truth, name), rtol=1e-14)
        terminated = truncated = False
        while not (terminated or truncated):
            action = rng.uniform(-1.2, 1.2, 1).astype(np.float32)
            observation, received, terminated, truncated, info = env.step(action)
            expected, rewards, *flags = twin.step(action)
            np.testing.assert_allclose(observation, expected, **ROUNDED)
            np.testing.assert_allclose(received, rewards[reward], rtol=1e-9, atol=1e-9)
            gains = (twin.reported["information_gain"], twin.reported["log_posterior"])
            told = (info["information_gain"], info["log_posterior_gain"])
            np.testing.assert_allclose(told, gains, rtol=1e-9, atol=1e-9)
            assert [terminated, truncated] == flags
            assert not info["diverged"]
        assert_beliefs_agree(info["belief"], twin.belief)
        endings.append((terminated, truncated))
    return endings
