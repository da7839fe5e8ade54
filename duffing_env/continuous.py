"""The tracks on the differential equation, with noises that nobody knows: version 1 of each."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from duffing_env.env import DuffingEnv
from duffing_env.experiment import Experiment, SimulatedExperiment
from estimator.checks import one_of
from estimator.models.difference import difference
from estimator.models.duffing import duffing
from estimator.models.model import Model


@dataclass(frozen=True)
class ContinuousExperiment(SimulatedExperiment):
    """An experiment on the plant ``sde``, with a new oscillator in every episode.

    The fields of `SimulatedExperiment` are the same, but for ``process_noise``: the standard deviation of what one
    sample's process noise alone does to x [V]. Oscillators are drawn about `CONTINUOUS_TWIN`.

    Attributes:
        estimator: ``ode``, the plant's own equation, structured; or ``nlarx``, the paper's difference equation, which
            no plant of this kind obeys.
    """

    estimator: str = "ode"

    def __post_init__(self) -> None:
        one_of("estimator", self.estimator, ("ode", "nlarx"))
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

    ## Action space

    `Box(-1, 1, (1,), float32)`; values outside are clipped.

    | Num | Action | Min | Max | Unit |
    |-----|--------|-----|-----|------|
    | 0 | input u_t in parts of ``max_input`` | -1 | 1 | ``max_input`` (0.15 V) |

    ## Observation space

    `Box(22, float32)`, every entry clipped to its bounds.

    | Num | Observation | Min | Max |
    |-----|-------------|-----|-----|
    | 0-3 | posterior means of k, κ, d, g: deviation from the prior's, in its standard deviations | -10 | 10 |
    | 4-7 | log of their standard deviations, relative to the prior's (0 at the start, falling) | -20 | 5 |
    | 8-13 | posterior correlations kκ, kd, kg, κd, κg, dg | -1 | 1 |
    | 14, 15 | log E[γ], log E[ξ] (process and measurement precision), relative to the prior's | -20 | 20 |
    | 16, 17 | filtered state E[x], E[x'] (x' in V per sample), in parts of ``max_output`` | -2 | 2 |
    | 18 | last input in parts of ``max_input`` | -1 | 1 |
    | 19 | last output in parts of ``max_output`` | -2 | 2 |
    | 20 | time left, in parts of the horizon | 0 | 1 |
    | 21 | input energy budget left; 1, as this track has none | 0 | 1 |

    With ``estimator="nlarx"`` entries 0 to 13, 16 and 17 are those of `DuffingEnv`: θ1, θ2, θ3, η, x_t and x_{t-1}.

    ## Reward

    By name (``reward=``), in nats but for the two errors; C is the posterior covariance of (k, κ, d, g), c* their
    true values. With ``estimator="nlarx"`` they are θ1, θ2, θ3, η, the true ones by Eq. (3), and the estimates of
    m, c, a, b by Eq. (4).

    | Name | Reward of a step | Range |
    |------|------------------|-------|
    | ``information_gain`` (default) | ½ log det C_{t-1} - ½ log det C_t | about 16 over an episode, mostly >= 0 |
    | ``log_posterior`` | log q_t(c*) - log q_{t-1}(c*) | unbounded below; its mean is at most the information gain |
    | ``parameter_error`` | e_{t-1} - e_t, e = mean of min(relative error, 1) over m, c, a, b | [-1, 1] |
    | ``fisher`` | as `DuffingEnv`, with the true noises; not with ``estimator="nlarx"`` | >= 0 |
    | ``expected_free_energy`` | ½ log det C_{t-1} - ½ log det C'_t, C'_t as expected before the outcome | >= 0 |
    | ``simulation_error`` | s_{t-1} - s_t, s the relative error of a free run, at most 1 | [-1, 1] |
    | ``free_energy`` | -F_t, the sample's free energy: a foil that rewards predictable outputs | unbounded |

    The ranges are those of an episode's sum; see `DuffingEnv`.

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

    | Argument | Default | Meaning |
    |----------|---------|---------|
    | ``estimator`` | ``ode`` | the plant's equation; or ``nlarx``, the paper's |
    | ``factorisation`` | ``structured`` | with ``estimator="nlarx"`` and one hypothesis also ``mean_field`` |
    | ``iterations`` | 3 or 10 | variational iterations per sample (structured, mean field) |
    | ``reward`` | ``information_gain`` | see above |
    | ``max_input`` | 0.15 | input limit [V] |
    | ``max_output`` | 0.6 | the sensor's limit [V] |
    | ``horizon`` | 256 | samples of an episode |
    | ``hold``, ``terminal``, ``terminated_return`` | 1, False, None | as `DuffingEnv` |
    | ``process_noise`` | 5e-4 | standard deviation of what a sample's process noise alone does to x [V]: the middle |
    | ``measurement_noise`` | 5e-4 | standard deviation of v [V]: the middle of its range |
    | ``spread`` | 0.3 | half width of the parameters' range, relative |
    | ``noise_range`` | 10 | largest over smallest of each noise; 1: they are the middle |
    | ``process_noise_guess``, ``measurement_noise_guess`` | None | as `DuffingEnv` |
    | ``noise_shape`` | 2 | shape of the Gamma priors of γ and ξ |
    | ``noise_hypotheses`` | 7 | as `DuffingEnv` |
    | ``plant_spread`` | ``spread`` | the same for the plant alone; 0: every oscillator is the twin |
    | ``branch`` | ``train`` | as `DuffingEnv` |
    | ``render_mode`` | None | ``rgb_array`` (needs no display) or ``human`` |

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

    experiment_kind: ClassVar[type[Experiment]] = ContinuousExperiment


class ContinuousShortEnv(ContinuousEnv):
    """Identify the oscillator of Eq. (1) within 48 samples: 79 ms, some five periods of its resonance.

    ## Description

    As `ContinuousEnv`, but ``horizon`` is 48: every sample counts, and the posterior is still wide, and the noises
    hardly known, when the best inputs must be chosen.

    ## Action space, observation space, reward, starting state, information

    As `ContinuousEnv`.

    ## Episode end

    As `ContinuousEnv`, truncated after 48 samples.

    ## Arguments

    As `ContinuousEnv`, with ``horizon`` 48.

    ## Version history

    * v1: Eq. (1) in place of Eq. (2), and noises that nobody knows
    """


class ContinuousPowerEnv(ContinuousEnv):
    """Identify the oscillator of Eq. (1) with an input of at most 22.2 mV RMS, that of the Silverbox multisine.

    ## Description

    As `ContinuousEnv`, with the budget of `PowerEnv`: over an episode Σ u² is at most ``horizon * max_rms**2``, and an
    input that what is left cannot pay for is cut to what it can.

    ## Action space, observation space

    As `PowerEnv`; the belief's entries as `ContinuousEnv`.

    ## Reward, starting state, episode end, information

    As `ContinuousEnv`.

    ## Arguments

    As `ContinuousEnv`, with ``max_rms`` 0.0222.

    ## Version history

    * v1: Eq. (1) in place of Eq. (2), and noises that nobody knows
    """


class ContinuousOutputEnv(ContinuousEnv):
    r"""Identify the oscillator of Eq. (1) without leaving \|y\| ≤ 0.3 V, the range seen on the real circuit.

    ## Description

    As `ContinuousEnv`, but the episode ends at half the displacement, so the input must feel its way.

    ## Action space, observation space, reward, starting state, information

    As `ContinuousEnv`; the states and the output are observed in parts of 0.3 V.

    ## Episode end

    As `ContinuousEnv`, terminated at \|y\| > 0.3 V.

    ## Arguments

    As `ContinuousEnv`, with ``max_output`` 0.3.

    ## Version history

    * v1: Eq. (1) in place of Eq. (2), and noises that nobody knows
    """
