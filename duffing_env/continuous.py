"""The track on the differential equation: `ContinuousEnv`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from duffing_env.env import DuffingEnv
from duffing_env.experiment import Experiment, SimulatedExperiment
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
        super().__post_init__()
        if self.estimator not in ["ode", "nlarx"]:
            raise ValueError(f"estimator must be one of ['ode', 'nlarx'], but is {self.estimator!r}")
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

    @property
    def degree(self) -> int:
        """The input goes linearly from one action to the next."""
        return 1


class ContinuousEnv(DuffingEnv):
    r"""The same task on the differential equation itself, sampled, with an estimator that integrates it.

    ## Description

    The oscillator m x'' + c x' + a x + b x³ = u + w, Eq. (1) of the paper, is a stochastic differential equation: w is
    white noise, and the equation is integrated in eight sub-steps of each sample of 1.6384 ms (Runge and Kutta's method
    of order 4 for the drift, the noise's two integrals drawn jointly). Between two samples the input goes linearly from
    the last action's to this one's, as a real generator with a reconstruction filter does. The sensor gives
    y_{t+1} = x_{t+1} + v.

    The estimator knows this equation, with time counted in samples,

        x'' = g u - d x' - k x - κ x³ + noise,    k = δ² a/m,  κ = δ² b/m,  d = δ c/m,  g = δ²/m,

    integrates it with exact sensitivities, and updates a joint Gaussian posterior over (x, x', k, κ, d, g) with every
    sample. ``estimator="nlarx"`` puts the paper's difference equation in its place, which this plant does not obey: a
    foil that shows what misspecification does (docs/continuous.md).

    ## Action space

    `Box(-1, 1, (1,), float32)`; values outside are clipped.

    | Num | Action | Min | Max | Unit |
    |-----|--------|-----|-----|------|
    | 0 | input at the end of the sample, in parts of ``max_input`` | -1 | 1 | ``max_input`` (0.15 V) |

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
    | ``expected_free_energy`` | ½ log det C_{t-1} - ½ log det C'_t, C'_t as expected before the outcome | >= 0 |
    | ``simulation_error`` | s_{t-1} - s_t, s the relative error of a free run, at most 1 | [-1, 1] |
    | ``free_energy`` | -F_t, the sample's free energy: a foil that rewards predictable outputs | unbounded |

    The ranges are those of an episode's sum; see `DuffingEnv`.

    ## Starting state

    m, c, a and b are drawn log-uniformly within ±30 % of the Silverbox circuit's continuous twin (5.3759e-6 s²,
    2.2525e-4 s, 0.99054, 3.9252 V⁻²). The oscillator is at rest, and the input was 0. The posterior is the prior:
    Gaussian, with the mean and covariance of the coefficients of oscillators so drawn; γ and ξ are Gamma of shape 2
    about the true noise precisions.

    ## Episode end

    - Termination: \|y\| > ``max_output`` (0.6 V), the sensor's limit, as this plant does not blow up; or a number that
      is not finite (``info["diverged"]``), which leaves the belief as it was before that step.
    - Truncation: after ``horizon`` (256) samples.

    ## Information

    Every step: ``information_gain`` and ``log_posterior_gain`` of the step [nats], ``diverged``. At the end of an
    episode also ``belief`` (`estimator.Belief`) and ``truth`` (`estimator.Parameters`). At any time:
    ``env.unwrapped.belief`` and ``env.unwrapped.truth``.

    ## Arguments

    | Argument | Default | Meaning |
    |----------|---------|---------|
    | ``estimator`` | ``ode`` | the plant's equation; or ``nlarx``, the paper's |
    | ``factorisation`` | ``structured`` | with ``estimator="nlarx"`` also ``mean_field`` |
    | ``iterations`` | 3 or 10 | variational iterations per sample (structured, mean field) |
    | ``reward`` | ``information_gain`` | see above |
    | ``max_input`` | 0.15 | input limit [V] |
    | ``max_output`` | 0.6 | the sensor's limit [V] |
    | ``horizon`` | 256 | samples of an episode |
    | ``hold``, ``terminal``, ``terminated_return`` | 1, False, None | as `DuffingEnv` |
    | ``process_noise`` | 5e-4 | standard deviation of what a sample's process noise alone does to x [V] |
    | ``measurement_noise`` | 5e-4 | standard deviation of v [V] |
    | ``spread`` | 0.3 | half width of the parameters' range, relative |
    | ``noise_range`` | 1 | both noises are drawn for every episode, as `DuffingEnv` |
    | ``process_noise_guess``, ``measurement_noise_guess`` | None | as `DuffingEnv` |
    | ``noise_shape`` | 2 | shape of the Gamma priors of γ and ξ |
    | ``noise_hypotheses`` | 1 | as `DuffingEnv` |
    | ``plant_spread`` | ``spread`` | the same for the plant alone; 0: every oscillator is the twin |
    | ``branch`` | ``train`` | as `DuffingEnv` |
    | ``render_mode`` | None | ``rgb_array`` (needs no display) or ``human`` |

    >>> import gymnasium as gym
    >>> import duffing_env
    >>> env = gym.make("duffing_env/Continuous-v0")
    >>> observation, info = env.reset(seed=1)
    >>> truncated = False
    >>> while not truncated:
    ...     observation, reward, terminated, truncated, info = env.step(env.action_space.sample())
    >>> list(info["belief"].coefficients())
    ['stiffness', 'cubic', 'damping', 'gain']
    >>> m, c, a, b = info["belief"].physical()[0]
    >>> bool(abs(m / info["truth"].m - 1) < 0.05)
    True

    ## Version history

    * v0: initial version
    """

    experiment_kind: ClassVar[type[Experiment]] = ContinuousExperiment
