"""A plain NumPy twin of `DuffingEnv`: a step written from the paper and the environment's docstring.

It shares no code with the kernel but the estimator, which has twins of its own under tests/estimator.
"""

from dataclasses import replace

import numpy as np

from estimator import NLARX, SILVERBOX_TWIN, OnlineEstimator, PhysicalParameters, Prior, to_coefficients

PARAMETERS = ("m", "c", "a", "b")


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

    def reset(self):
        """Draw an oscillator, put it at rest, and return the first observation."""
        low, high = 1.0 - self.spread, 1.0 + self.spread
        factors = [low * (high / low) ** self.stream.uniform() for _ in PARAMETERS]
        drawn = [getattr(SILVERBOX_TWIN, name) * f for name, f in zip(PARAMETERS, factors, strict=True)]
        self.truth = PhysicalParameters(*drawn)
        self.coefficients = to_coefficients(self.truth)
        self.x = self.last_x = self.u = self.y = self.spent = 0.0
        self.elapsed = 0
        if self.jump:
            self.jump_at = int(self.horizon * (0.25 + 0.5 * self.stream.uniform()))
            self.jump_factor = (1.0 - self.jump) * ((1.0 + self.jump) / (1.0 - self.jump)) ** self.stream.uniform()
        self.estimator = OnlineEstimator(
            NLARX(input_delay=0), self.prior, self.factorisation, self.iterations, drift=self.drift
        )
        self.first_belief = self.belief
        self.ideal_cov = np.zeros((6, 6))  # of (x_t, x_{t-1}, θ, η), for one who knows the truth
        self.ideal_cov[:2, :2] = self.first_belief.state_cov[:2, :2]
        self.ideal_cov[2:, 2:] = self.first_belief.coefficients_cov
        self._worth = self._appraise()
        return self.observation()

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
            self.coefficients = to_coefficients(self.truth)
            self._worth = self._appraise()
        fisher = self._fisher_gain()
        w, v = self.stream.normal_pair()
        psi = self.coefficients
        moved = psi.theta1 * self.x + psi.theta2 * self.x**3 + psi.theta3 * self.last_x + psi.eta * self.u
        self.x, self.last_x = moved + self.process_noise * w, self.x
        self.y = self.x + self.measurement_noise * v
        self.estimator.update(self.u, self.y)
        self.elapsed += 1
        before, self._worth = self._worth, self._appraise()
        rewards = {name: self._worth[name] - before[name] for name in before}
        rewards["free_energy"] = -self.estimator.free_energy
        rewards["fisher"] = fisher
        cost = self.input_cost * (self.u / self.max_input) ** 2
        terminated = abs(self.y) > self.max_output
        self.reported = dict(rewards)
        rewards = {name: reward - cost for name, reward in rewards.items()}
        return self.observation(), rewards, terminated, self.elapsed == self.horizon and not terminated

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

    def _appraise(self):
        """What the belief is worth by each reward that is a difference: a step's reward is its increase."""
        mean, _ = self.belief.physical()
        truth = np.array([getattr(self.truth, name) for name in PARAMETERS])
        return {
            "information_gain": -self.belief.entropy(),
            "log_posterior": self.belief.log_prob(self.coefficients),
            "parameter_error": -np.minimum(np.abs(mean / truth - 1.0), 1.0).mean(),
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
