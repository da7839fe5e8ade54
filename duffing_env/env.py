"""The single environment as `gymnasium.Env`: one experiment, one action per step."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, ClassVar

import gymnasium as gym
import numpy as np
import numpy.typing as npt
from gymnasium.error import ResetNeeded

from duffing_env.batch import Batch
from duffing_env.custom_observation_and_reward import CustomFunctions
from duffing_env.env_common import (
    ExperimentEnv,
    action_of_several,
    action_space,
    check_reset_options,
    make_experiment,
    observation_space,
    refuse_concurrent_calls,
    scalar_action,
)
from duffing_env.experiment_config import Experiment, SimulatedExperiment
from duffing_env.kernel import RESET_MANUALLY
from duffing_env.storage.kernel_spec import SUMMED_OUTCOMES
from estimator.belief import Belief
from estimator.models.named_parameters import Parameters
from estimator.support.argument_checks import check_choice
from estimator.support.array_types import FloatArray

if TYPE_CHECKING:
    from duffing_env.rendering.episode_renderer import EpisodeRenderer

Observation = npt.NDArray[np.float32]


class DuffingEnv(ExperimentEnv, gym.Env[Any, Any]):
    r"""Choose the input of a Duffing oscillator so that its parameters are identified.

    ## Description

    An oscillator m x'' + c x' + a x + b x³ = u + w with unknown m, c, a, b is sampled every 1.6384 ms. At each step
    the agent applies the input u_t, the plant moves from x_t to x_{t+1}, the sensor measures y_{t+1} = x_{t+1} + v, and
    an online estimator updates its posterior over the coefficients (θ1, θ2, θ3, η) of the difference equation

        x_{t+1} = θ1 x_t + θ2 x_t³ + θ3 x_{t-1} + η u_t + w̃_t

    by free energy minimisation (Kouw 2020). **The observation is that posterior.** Good inputs make it contract.

    ## Action space

    `Box(-1, 1, (1,), float32)`; values outside are clipped.

    | Num | Action | Min | Max | Unit |
    |-----|--------|-----|-----|------|
    | 0 | input u_t in parts of ``max_input`` | -1 | 1 | ``max_input`` (0.15 V) |

    ## Observation space

    `Box(22, float32)`, every entry clipped to its bounds.

    | Num | Observation | Min | Max |
    |-----|-------------|-----|-----|
    | 0-3 | posterior means of θ1, θ2, θ3, η: deviation from the prior's, in its standard deviations | -10 | 10 |
    | 4-7 | log of their standard deviations, relative to the prior's (0 at the start, falling) | -20 | 5 |
    | 8-13 | posterior correlations θ1θ2, θ1θ3, θ1η, θ2θ3, θ2η, θ3η | -1 | 1 |
    | 14, 15 | log E[γ], log E[ξ] (process and measurement precision), relative to the prior's | -20 | 20 |
    | 16, 17 | filtered states E[x_t], E[x_{t-1}] in parts of ``max_output`` | -2 | 2 |
    | 18 | last input in parts of ``max_input`` | -1 | 1 |
    | 19 | last output in parts of ``max_output`` | -2 | 2 |
    | 20 | time left, in parts of the horizon | 0 | 1 |
    | 21 | part of the input's energy budget that is left; 1 without a budget (``max_rms``) | 0 | 1 |

    This is ``observation="posterior"``. ``"privileged"`` appends the true coefficients, scaled as the means of entries
    0-3, for training and tests. ``"history"`` shows no belief, but the last ``history`` inputs and outputs, scaled as
    entries 18 and 19, the oldest first, each step's input before its outputs, and then entries 20 and 21. A function of
    the beliefs shows its own values (docs/extending.md).

    ## Reward

    By name (``reward=``), in nats except for the two errors; C is the posterior covariance of (θ, η), c* the truth.

    | Name | Reward of a step | Range |
    |------|------------------|-------|
    | ``information_gain`` (default) | ½ log det C_{t-1} - ½ log det C_t | about 20 over an episode, mostly >= 0 |
    | ``log_posterior`` | log q_t(c*) - log q_{t-1}(c*) | unbounded below; its mean is at most the information gain |
    | ``parameter_error`` | e_{t-1} - e_t, e = mean of min(relative error, 1) over m, c, a, b | [-1, 1] |
    | ``fisher`` | ½ log det(Λ0 + F_t) - ½ log det(Λ0 + F_{t-1}), F the Fisher information at the truth | >= 0 |
    | ``expected_free_energy`` | ½ log det C_{t-1} - ½ log det C'_t, C'_t as expected before the outcome | >= 0 |
    | ``simulation_error`` | s_{t-1} - s_t, s the relative error of a free run, at most 1 | [-1, 1] |
    | ``free_energy`` | -F_t, the sample's free energy: a foil that rewards predictable outputs | unbounded |

    The ranges are for an episode's sum. `duffing_env.rewards.named_rewards` (the manual's page "Rewards") gives the
    bounds and the weaknesses of each. A terminated episode keeps its gain unless ``terminated_return`` is set;
    ``terminal`` pays the whole sum in the last step.

    ## Starting state

    m, c, a and b are drawn log-uniformly within ±30 % of the Silverbox circuit's twin (6.4568e-6 s², 2.5717e-4 s,
    1.1747, 3.7672 V⁻²). The oscillator is at rest. The posterior is the prior: Gaussian, with the mean and covariance
    of the coefficients of oscillators so drawn; γ and ξ are Gamma of shape 2 about the true noise precisions.

    With ``noise_range`` above 1 each noise's standard deviation is drawn log-uniformly about ``process_noise`` and
    ``measurement_noise``, over a range of that factor: 10 is a decade, from 1/√10 to √10 times. The prior stays at the
    middle of the range or at the guesses, and ``truth`` includes ``process_noise`` and ``measurement_noise``.

    A single filter hardly learns the ratio of the two noises. With ``noise_hypotheses`` above 1 the estimator weighs
    that number of ratios by their evidence, as `estimator.OnlineEstimator` does, each at three levels, which takes
    three updates for each ratio and sample; 9 ratios are enough. A pair such as (5, 5) gives the numbers of values of
    each noise, a factor of 3 apart, in all combinations: for two guesses that may be wrong independently. Observation,
    ``belief``, information and the rewards by the belief then use the mixture's mean and covariance; ``free_energy`` is
    the free energy of the mixture. This needs ``structured``. Several sensors share the factor on their noises.

    ## Episode end

    - Termination: \|y\| > ``max_output`` (0.6 V); or a number that is not finite (``info["diverged"]``), which leaves
      the belief as it was before that step.
    - Truncation: after ``horizon`` (256) samples.

    ## Information

    ``information_gain`` and ``log_posterior_gain`` of the step [nats], summed over the samples of a held action, and
    ``diverged``; at a reset they are 0 and False. ``env.unwrapped.belief`` (`estimator.Belief`) and
    ``env.unwrapped.truth`` (`estimator.Parameters`) can be read at any time, also between the end of an episode and the
    next reset. A vector environment puts both into the infos of the rows that finish.

    ``reset(options={"truth": truth})`` starts with a chosen system: a dict or `estimator.Parameters` of m, c, a and b,
    and of the noises where these are drawn (noises left out are drawn as usual). All other random numbers stay as the
    seed gives them.

    ## Arguments

    | Argument | Default | Meaning |
    |----------|---------|---------|
    | ``factorisation`` | ``structured`` | the estimator's: ``structured`` or ``mean_field`` |
    | ``iterations`` | 3 or 10 | variational iterations per sample (structured, mean field) |
    | ``reward`` | ``information_gain`` | see above; or a function (`duffing_env.custom_observation_and_reward`) |
    | ``observation`` | ``posterior`` | or ``history``, ``privileged``, or a function |
    | ``history`` | 16 | steps that the observation ``history`` shows |
    | ``max_input`` | 0.15 | input limit [V] |
    | ``max_output`` | 0.6 | displacement limit [V] |
    | ``horizon`` | 256 | samples of an episode |
    | ``hold`` | 1 | samples for which an action is applied; see below |
    | ``terminal`` | False | pay the episode's whole reward in its last step, and 0 before |
    | ``terminated_return`` | None | return of a terminated episode, whatever it gained; None keeps the gain |
    | ``process_noise`` | 5e-4 | standard deviation of w̃ [V] |
    | ``measurement_noise`` | 5e-4 | standard deviation of v [V] |
    | ``spread`` | 0.3 | half width of the parameters' range, relative, in (0, 1) |
    | ``noise_range`` | 1 | factor over which both noises are drawn for every episode; see above |
    | ``process_noise_guess`` | None | centre of the prior of γ [V]; None: ``process_noise`` |
    | ``measurement_noise_guess`` | None | centre of the prior of ξ [V]; None: ``measurement_noise`` |
    | ``noise_shape`` | 2 | shape of these Gamma priors; 2 is weak |
    | ``noise_hypotheses`` | 1 | number of noise ratios to weigh by their evidence; see above |
    | ``plant_spread`` | ``spread`` | ``spread`` of the plants, if other than the prior's; 0: all are the twin |
    | ``mean`` | None | name to the middle of its range, for some or all parameters; else the twin's |
    | ``prior`` | None | an `estimator.Belief` to start from; None: the one that fits plants and noises |
    | ``max_rms`` | None | largest RMS input over a whole episode [V]; see `PowerEnv` |
    | ``max_slew`` | None | largest change of the input between samples [V]; a larger one is cut |
    | ``input_cost`` | 0 | cost of (u / ``max_input``)² in every sample, taken off the reward |
    | ``jump``, ``drift`` | 0 | a mass that jumps, an estimator that expects change; see `DriftEnv` |
    | ``branch`` | ``train`` | branch of the seeds: ``train``, ``validation`` or ``test``; see below |
    | ``render_mode`` | None | ``rgb_array`` (needs no display) or ``human`` |

    The same seed gives other oscillators and other noise in each ``branch``. An agent trained in ``train``, with any
    seed, has never met a system of ``test``, on which `evaluate.py` compares.

    With ``hold`` a step equals that number of steps with the same action, to the bit: its reward is the sum of their
    rewards, limits apply to every sample, and an episode may end within the step. ``horizon`` counts samples, so an
    episode has ceil(horizon / hold) steps, and the last may be shorter; a step returns its last sample's observation.

    >>> import gymnasium as gym
    >>> import duffing_env
    >>> env = gym.make("duffing_env/Amplitude-v0", reward="log_posterior")
    >>> observation, info = env.reset(seed=1)
    >>> _ = env.action_space.seed(1)
    >>> total = 0.0
    >>> for _ in range(256):
    ...     observation, reward, terminated, truncated, info = env.step(env.action_space.sample())
    ...     total += reward
    >>> truncated, sorted(info)
    (True, ['diverged', 'information_gain', 'log_posterior_gain'])
    >>> m, c, a, b = env.unwrapped.belief.physical()[0]
    >>> bool(abs(m / env.unwrapped.truth.m - 1) < 0.05)
    True

    ## Version history

    * v0: initial version
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array", "human"], "render_fps": 30}  # noqa: RUF012
    experiment_class: ClassVar[type[Experiment]] = SimulatedExperiment

    @classmethod
    def _experiment_class(cls) -> type[Experiment]:
        return cls.experiment_class

    def __init__(self, *, render_mode: str | None = None, **options: Any) -> None:
        if render_mode is not None:
            check_choice("render_mode", render_mode, self.metadata["render_modes"])
        self.experiment = make_experiment(self.experiment_class, options)
        self.observation_space = observation_space(self.experiment)
        self.action_space = action_space(self.experiment)
        self._n_inputs = self.experiment.model.n_inputs
        self.render_mode = render_mode
        self._batch = Batch(self.experiment, 1, RESET_MANUALLY)
        self._custom = CustomFunctions.for_batch(self._batch)
        self._first_sensor = next(iter(self.experiment.truth_model.outputs))
        self._seeded_generator: np.random.Generator | None = None
        self._running = False
        self._call_token = [None]
        self._renderer: EpisodeRenderer | None = None

    @property
    def belief(self) -> Belief:
        """The posterior now."""
        return self._batch.belief(0)

    @property
    def truth(self) -> Parameters:
        """The true parameters of the oscillator.

        Raises:
            gymnasium.error.ResetNeeded: before the first reset, which draws it.
        """
        if self._seeded_generator is None:
            raise ResetNeeded("no system is drawn yet: call reset() before you ask for the truth")
        return self._batch.truth_of(0)

    @refuse_concurrent_calls
    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Draw an oscillator and start an episode.

        Args:
            seed: seed of oscillator and noise; without it the stream of random numbers continues.
            options: may hold ``truth``, a chosen system.

        Raises:
            ValueError: for another option or an invalid system; nothing has changed then.
        """
        options = check_reset_options(options, *self._reset_options)
        chosen_truth = self._batch.parse_truth(options["truth"]) if "truth" in options else None
        self._reset_plant()
        super().reset(seed=seed)
        if self.np_random is not self._seeded_generator:
            self._seeded_generator = self.np_random
            self._batch.seed(0, self.np_random)
        all_envs = np.ones(1, dtype=np.bool_)
        self._batch.reset(all_envs)
        if chosen_truth is not None:
            self._batch.restart_with_truth(all_envs, chosen_truth)
        if self._custom is not None:
            self._custom.start_episodes(all_envs)
        self._running = True
        if self.render_mode is not None:
            self._start_drawing()
        return self._observation(), self._info(self._batch.outcome(0))

    @refuse_concurrent_calls
    def step(self, action: npt.ArrayLike) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Apply the inputs of an action for ``hold`` samples, or until the episode ends.

        Raises:
            ValueError: if the action is not one finite number for each input; nothing has changed then.
            gymnasium.error.ResetNeeded: before the first reset, and after the end of an episode.
        """
        if not self._running:
            raise ResetNeeded("the episode is over or has not begun: call reset() before step()")
        n = self._n_inputs
        clipped_action, custom = scalar_action(action) if n == 1 else action_of_several(action, n), self._custom
        if custom is not None:
            custom.before_step()
        outcome = self._play_action(clipped_action)
        if custom is not None:
            outcome["reward"] += float(custom.step_rewards(None)[0])
            custom.observe_step(None)
        terminated, truncated = bool(outcome["terminated"]), bool(outcome["truncated"])
        self._running = not (terminated or truncated)
        return self._observation(), outcome["reward"], terminated, truncated, self._info(outcome)

    def _observation(self) -> Observation:
        observation: Observation = self._observation_owner.observations[0].copy()
        return observation

    def _reset_plant(self) -> None:
        """Bring an external plant to rest before an episode; simulated plants need nothing."""

    #: Names of the options of a reset.
    _reset_options: ClassVar[tuple[str, ...]] = ("truth",)
    _info_gains: ClassVar[tuple[str, ...]] = ("information_gain", "log_posterior_gain")
    _info_flags: ClassVar[tuple[str, ...]] = ("diverged",)

    def _info(self, outcome: dict[str, float]) -> dict[str, Any]:
        info: dict[str, Any] = {name: outcome[name] for name in self._info_gains}
        for flag in self._info_flags:
            info[flag] = bool(outcome[flag])
        return info

    def _play_action(self, action: float | FloatArray) -> dict[str, float]:
        """Hold the action for its samples; return the sums of their rewards and gains, and the last one's flags."""
        # The kernel can hold an action as well; here each sample is a call, as it is drawn or given to a real plant.
        outcome = self._play_sample(action)
        for _ in range(1, self.experiment.hold):
            if outcome["terminated"] or outcome["truncated"]:
                break
            before, outcome = outcome, self._play_sample(action)
            for name in SUMMED_OUTCOMES:
                outcome[name.lower()] += before[name.lower()]
        return outcome

    def _play_sample(self, action: float | FloatArray) -> dict[str, float]:
        self._apply_sample(action)
        if self._renderer is not None:
            self._draw_sample()
        return self._batch.outcome(0)

    def _apply_sample(self, action: float | FloatArray) -> None:
        """Step one sample; the action is in [-1, 1], or has (inputs,) such numbers."""
        self._batch.step(action)

    def render(self) -> npt.NDArray[np.uint8] | None:
        """Draw input, output and posterior so far: an RGB array (height, width, 3) in mode ``rgb_array``."""
        if self.render_mode is None or self._renderer is None:
            gym.logger.warn("render() draws nothing: make the environment with render_mode='rgb_array', and reset it")
            return None
        return self._renderer.frame() if self.render_mode == "rgb_array" else None

    def _start_drawing(self) -> None:
        from duffing_env.rendering.episode_renderer import EpisodeRenderer

        if self._renderer is None:
            experiment, fps = self.experiment, self.metadata["render_fps"]
            limits = dict(zip(experiment.model.inputs, experiment.max_inputs.tolist(), strict=True))
            self._renderer = EpisodeRenderer(self.render_mode, limits, experiment.max_output, fps, experiment.scales)
        self._renderer.start(self._batch.truth_of(0), self.belief, self.horizon)

    def _draw_sample(self) -> None:
        assert self._renderer is not None
        u, y = self._batch.applied_inputs()[0], self._batch.row_values(f"Y_{self._first_sensor}")[0]
        self._renderer.add_sample(u, float(y), self.belief)

    def close(self) -> None:
        """Close the window, if there is one."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None
