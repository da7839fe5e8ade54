"""The tracks on the differential equation with unknown noises, which are the versions 1."""

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
    """An experiment on the differential equation; `ContinuousEnv` describes its options."""

    estimator: str = "ode"

    def __post_init__(self) -> None:
        check_choice("estimator", self.estimator, ("ode", "nlarx"))
        super().__post_init__()
        if self.reward == "fisher" and self.estimator != "ode":
            raise ValueError(
                "reward must not be 'fisher' for estimator='nlarx', because the plant does not obey its equation; use "
                "'log_posterior'"
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
    r"""The same task on the sampled differential equation itself, with unknown noises.

    ## Description

    The oscillator m x'' + c x' + a x + b x³ = u + w, Eq. (1) of the paper, is a stochastic differential equation: w is
    white noise, and the equation is integrated in eight sub-steps of each sample of 1.6384 ms (Runge and Kutta's method
    of order 4 for the drift, the noise's two integrals drawn jointly). The input is held over a sample, as a converter
    does. The sensor measures y_{t+1} = x_{t+1} + v. The strengths of w and v differ from episode to episode, over a
    decade each, and are unknown to estimator and agent.

    The estimator uses this equation, with time counted in samples,

        x'' = g u - d x' - k x - κ x³ + noise,    k = δ² a/m,  κ = δ² b/m,  d = δ c/m,  g = δ²/m,

    integrates it with exact sensitivities, and updates a joint Gaussian posterior over (x, x', k, κ, d, g) with every
    sample; seven ratios of the noises at three levels each are weighed by their evidence (``noise_hypotheses``).
    ``estimator="nlarx"`` uses the paper's difference equation instead, which this plant does not obey: a foil that
    shows the effect of misspecification (docs/evidence/continuous.md).

    ## Action space, observation space

    As `DuffingEnv`, with k, κ, d, g in place of θ1, θ2, θ3, η (entries 0 to 13), and E[x], E[x'] as the filtered state
    (16, 17; x' in V per sample). With ``estimator="nlarx"`` all entries are as in `DuffingEnv`.

    ## Reward

    As `DuffingEnv`, with C the posterior covariance of (k, κ, d, g) and c* their true values; an episode gains about
    16 nats of information. ``fisher`` uses the true noises. With ``estimator="nlarx"`` there is no ``fisher``, and C
    and c* are of θ1, θ2, θ3, η: the true ones by Eq. (3), the estimates of m, c, a, b by Eq. (4).

    ## Starting state

    m, c, a and b are drawn log-uniformly within ±30 % of the Silverbox circuit's continuous twin (5.3759e-6 s²,
    2.2525e-4 s, 0.99054, 3.9252 V⁻²). The oscillator is at rest, and the input was 0. The standard
    deviations of both noises are log-uniform on 1/√10 to √10 times ``process_noise`` and ``measurement_noise``. The
    posterior is the prior: Gaussian, with the mean and covariance of the coefficients of oscillators so drawn; γ and ξ
    are mixtures of Gamma densities of shape 2 about the middle of the range.

    ## Episode end

    - Termination: \|y\| > ``max_output`` (0.6 V), the sensor's limit (this plant does not blow up); or a number that is
      not finite (``info["diverged"]``), which leaves the belief as it was before that step.
    - Truncation: after ``horizon`` (256) samples.

    ## Information

    As `DuffingEnv`; the truth includes ``process_noise`` and ``measurement_noise``.

    ## Arguments

    As `DuffingEnv`, except for:

    | Argument | Default | Meaning |
    |----------|---------|---------|
    | ``estimator`` | ``ode`` | the plant's equation; or ``nlarx``, the paper's |
    | ``factorisation`` | ``structured`` | with ``estimator="nlarx"`` and one hypothesis also ``mean_field`` |
    | ``process_noise`` | 5e-4 | standard deviation of one sample's effect of w on x [V]: the middle of its range |
    | ``measurement_noise`` | 5e-4 | standard deviation of v [V]: the middle of its range |
    | ``noise_range`` | 10 | largest over smallest standard deviation of each noise; 1: the middle |
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

    * v1: Eq. (1) in place of Eq. (2), and unknown noises
    """

    experiment_class: ClassVar[type[Experiment]] = ContinuousExperiment


class ContinuousShortEnv(ContinuousEnv):
    """Identify the oscillator of Eq. (1) within 48 samples: 79 ms, some five periods of its resonance.

    ## Description

    As `ContinuousEnv`, but ``horizon`` is 48, after which an episode is truncated: every sample counts, and the
    posterior is still wide, and the noises hardly known, when the best inputs must be chosen.

    ## Version history

    * v1: Eq. (1) in place of Eq. (2), and unknown noises
    """


class ContinuousPowerEnv(ContinuousEnv):
    """Identify the oscillator of Eq. (1) with an input of at most 22.2 mV RMS, as the Silverbox multisine has.

    ## Description

    As `ContinuousEnv`, with the budget of `PowerEnv`: over an episode Σ u² is at most ``horizon * max_rms**2``, with
    ``max_rms`` 0.0222, and an input beyond the rest of the budget is cut. Observations 18 and 21 are as in `PowerEnv`.

    ## Version history

    * v1: Eq. (1) in place of Eq. (2), and unknown noises
    """


class ContinuousOutputEnv(ContinuousEnv):
    r"""Identify the oscillator of Eq. (1) within \|y\| ≤ 0.3 V, the output range of the real circuit.

    ## Description

    As `ContinuousEnv`, but ``max_output`` is 0.3: an episode is terminated at half the displacement, which also scales
    the observed states and output. So the input must be cautious.

    ## Version history

    * v1: Eq. (1) in place of Eq. (2), and unknown noises
    """


class ContinuousVectorEnv(DuffingVectorEnv):
    """Many `ContinuousEnv` at once."""

    single_env_class: ClassVar[type[DuffingEnv]] = ContinuousEnv
