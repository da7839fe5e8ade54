"""The tracks on the differential equation, with noises that nobody knows: version 1 of each."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from duffing_env.env import DuffingEnv
from duffing_env.experiment_config import Experiment, SimulatedExperiment
from duffing_env.vector_env import DuffingVectorEnv
from estimator.models.difference_equation import difference
from estimator.models.duffing import duffing
from estimator.models.model import Model
from estimator.support.argument_checks import check_choice


@dataclass(frozen=True)
class ContinuousExperiment(SimulatedExperiment):
    """An experiment on the differential equation; `ContinuousEnv` says what its options are."""

    estimator: str = "ode"

    def __post_init__(self) -> None:
        check_choice("estimator", self.estimator, ("ode", "nlarx"))
        super().__post_init__()
        if self.reward == "fisher" and self.estimator != "ode":
            raise ValueError(
                "reward must not be 'fisher' for estimator='nlarx', whose equation the plant does not obey"
            )
        if self.estimator == "ode" and self.factorisation != "structured":
            raise ValueError(
                f"factorisation must be 'structured' for estimator='ode', but is {self.factorisation!r}; mean field "
                f"is for estimator='nlarx'"
            )

    @property
    def plant(self) -> Model:
        """The differential equation."""
        return duffing()

    @property
    def model(self) -> Model:
        """The plant's equation, or the paper's."""
        return self.plant if self.estimator == "ode" else difference()


class ContinuousEnv(DuffingEnv):
    r"""The same task on the differential equation itself, sampled, with noises that nobody knows.

    ## Description

    The oscillator m x'' + c x' + a x + b x³ = u + w, Eq. (1) of the paper, is a stochastic differential equation: w is
    white noise, and the equation is integrated in eight sub-steps of each sample of 1.6384 ms (Runge and Kutta's method
    of order 4 for the drift, the noise's two integrals drawn jointly). The input is held over a sample, as a converter
    does. The sensor gives y_{t+1} = x_{t+1} + v. How strong w and v are differs from episode to episode, over a decade
    each, and neither estimator nor agent is told.

    The estimator knows this equation, with time counted in samples,

        x'' = g u - d x' - k x - κ x³ + noise,    k = δ² a/m,  κ = δ² b/m,  d = δ c/m,  g = δ²/m,

    integrates it with exact sensitivities, and updates a joint Gaussian posterior over (x, x', k, κ, d, g) with every
    sample; seven ratios of the noises at three levels each are weighed by their evidence (``noise_hypotheses``).
    ``estimator="nlarx"`` puts the paper's difference equation in its place, which this plant does not obey: a
    foil that shows what misspecification does (docs/continuous.md).

    ## Action space, observation space

    As `DuffingEnv`, with k, κ, d, g in place of θ1, θ2, θ3, η (entries 0 to 13), and E[x], E[x'] as the filtered state
    (16, 17; x' in V per sample). With ``estimator="nlarx"`` all are those of `DuffingEnv`.

    ## Reward

    As `DuffingEnv`, with C the posterior covariance of (k, κ, d, g) and c* their true values; the information gained
    over an episode is about 16 nats. ``fisher`` counts with the true noises. With ``estimator="nlarx"`` there is no
    ``fisher``, and C and c* are of θ1, θ2, θ3, η: the true ones by Eq. (3), the estimates of m, c, a, b by Eq. (4).

    ## Starting state

    m, c, a and b are drawn log-uniformly within ±30 % of the Silverbox circuit's continuous twin (5.3759e-6 s²,
    2.2525e-4 s, 0.99054, 3.9252 V⁻²). The oscillator is at rest, and the input was 0. The standard
    deviations of both noises are log-uniform on 1/√10 to √10 times ``process_noise`` and ``measurement_noise``. The
    posterior is the prior: Gaussian, with the mean and covariance of the coefficients of oscillators so drawn; γ and ξ
    are mixtures of Gamma densities of shape 2 about the middle of the range.

    ## Episode end

    - Termination: \|y\| > ``max_output`` (0.6 V), the sensor's limit, as this plant does not blow up; or a number that
      is not finite (``info["diverged"]``), which leaves the belief as it was before that step.
    - Truncation: after ``horizon`` (256) samples.

    ## Information

    As `DuffingEnv`; the truth has ``process_noise`` and ``measurement_noise``, too.

    ## Arguments

    As `DuffingEnv`, but for:

    | Argument | Default | Meaning |
    |----------|---------|---------|
    | ``estimator`` | ``ode`` | the plant's equation; or ``nlarx``, the paper's |
    | ``factorisation`` | ``structured`` | with ``estimator="nlarx"`` and one hypothesis also ``mean_field`` |
    | ``process_noise`` | 5e-4 | standard deviation of what a sample's process noise alone does to x [V]: the middle |
    | ``measurement_noise`` | 5e-4 | standard deviation of v [V]: the middle of its range |
    | ``noise_range`` | 10 | largest over smallest of each noise; 1: they are the middle |
    | ``noise_hypotheses`` | 7 | as `DuffingEnv` |

    >>> import gymnasium as gym
    >>> import duffing_env
    >>> env = gym.make("duffing_env/Amplitude-v1")
    >>> observation, info = env.reset(seed=1)
    >>> _ = env.action_space.seed(1)
    >>> truncated = False
    >>> while not truncated:
    ...     observation, reward, terminated, truncated, info = env.step(env.action_space.sample())
    >>> belief = env.unwrapped.belief
    >>> list(belief.coefficients())
    ['stiffness', 'cubic', 'damping', 'gain']
    >>> m, c, a, b = belief.physical()[0]
    >>> bool(abs(m / env.unwrapped.truth.m - 1) < 0.05)
    True

    ## Version history

    * v1: Eq. (1) in place of Eq. (2), and noises that nobody knows
    """

    experiment_class: ClassVar[type[Experiment]] = ContinuousExperiment


class ContinuousShortEnv(ContinuousEnv):
    """Identify the oscillator of Eq. (1) within 48 samples: 79 ms, some five periods of its resonance.

    ## Description

    As `ContinuousEnv` in all, but ``horizon`` is 48, after which an episode is truncated: every sample counts, and the
    posterior is still wide, and the noises hardly known, when the best inputs must be chosen.

    ## Version history

    * v1: Eq. (1) in place of Eq. (2), and noises that nobody knows
    """


class ContinuousPowerEnv(ContinuousEnv):
    """Identify the oscillator of Eq. (1) with an input of at most 22.2 mV RMS, that of the Silverbox multisine.

    ## Description

    As `ContinuousEnv` in all, with the budget of `PowerEnv`: over an episode Σ u² is at most ``horizon * max_rms**2``,
    with ``max_rms`` 0.0222, and an input that what is left cannot pay for is cut to what it can. Observations 18 and 21
    are as there.

    ## Version history

    * v1: Eq. (1) in place of Eq. (2), and noises that nobody knows
    """


class ContinuousOutputEnv(ContinuousEnv):
    r"""Identify the oscillator of Eq. (1) without leaving \|y\| ≤ 0.3 V, the range seen on the real circuit.

    ## Description

    As `ContinuousEnv` in all, but ``max_output`` is 0.3: the episode is terminated at half the displacement, in parts
    of which the states and the output are observed. So the input must feel its way.

    ## Version history

    * v1: Eq. (1) in place of Eq. (2), and noises that nobody knows
    """


class ContinuousVectorEnv(DuffingVectorEnv):
    """Many `ContinuousEnv` at once."""

    single_env_class: ClassVar[type[DuffingEnv]] = ContinuousEnv
