"""A plant of one's own as the environment: anything that takes an input in volts and gives an output in volts."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar, Protocol, SupportsFloat

import numpy as np

from duffing_env.env import DuffingEnv, Observation
from duffing_env.experiment import Experiment
from duffing_env.rewards import REWARDS
from estimator.belief import Belief
from estimator.models.difference import difference
from estimator.models.model import Model
from estimator.parameters import Parameters
from estimator.priors import silverbox_prior


class Plant(Protocol):
    """What a plant is: a simulator, a circuit behind a converter, a process behind a socket."""

    def reset(self) -> object:
        """Bring the plant to rest, with no input; what is returned is not looked at."""

    def step(self, u: float) -> SupportsFloat:
        """Apply the input u [V] for one sampling step, and give the output at its end [V]."""
        ...


@dataclass(frozen=True)
class PlantExperiment(Experiment):
    """An experiment on a plant whose parameters nobody knows.

    Attributes:
        horizon: samples of an episode; it is then truncated.
        prior: the belief that every episode starts from; that of Amplitude-v0 where it is None.
    """

    horizon: int = 256
    prior: Belief | None = None

    def __post_init__(self) -> None:
        if self.prior is not None and not isinstance(self.prior, Belief):
            raise ValueError(f"prior must be an estimator.Belief or None, but is {self.prior!r:.60}")
        super().__post_init__()
        self._check_count("horizon")
        if REWARDS[self.reward].needs_truth:
            raise ValueError(
                f"reward must not be {self.reward!r} for a plant of one's own, whose true oscillator nobody knows; "
                "use 'information_gain', 'expected_free_energy' or 'free_energy'"
            )
        if self.model.n_outputs != 1:
            raise ValueError(
                f"prior must be of a model with one sensor, but {self.model.name!r} has {self.model.n_outputs}; "
                "a plant gives one number"
            )

    @property
    def samples(self) -> int:
        """The horizon."""
        return self.horizon

    @property
    def model(self) -> Model:
        """That of the prior; the paper's where there is none."""
        return difference() if self.prior is None else self.prior.model

    @property
    def step(self) -> float:
        """That of the prior."""
        return self.believed.step

    @cached_property
    def believed(self) -> Belief:
        """The prior as given, or that of Amplitude-v0."""
        return self.prior or silverbox_prior().factorised(self.factorisation)


class PlantEnv(DuffingEnv):
    r"""Identify a plant of one's own: a circuit, a rig, another simulator.

    ## Description

    As `DuffingEnv`, but the input goes to ``plant``, and the output comes from it. A plant is any object with two
    methods: ``reset()`` brings it to rest, and ``step(u)`` applies u volts for one sampling step and returns the output
    at its end, in volts. Estimator, reward and observation are the compiled step of the other tracks, so a policy that
    was trained on them plays here as it is; one with foresight keeps to ``max_output``, if `make_policy` is given the
    environment.

    What the plant gets is what the estimator is told: the action in float32, clipped to [-1, 1], times ``max_input``.
    ``step`` has to keep the time: it returns when the sample is there. Nothing is applied between two calls of the
    environment's ``step``, and nothing after the end of an episode until ``reset``: that of the plant must switch its
    input off. The compiled step is ready before the plant is first touched.

    The plant's sampling step need not be 1.6384 ms; the coefficients are those of the prior's model at its own, and
    ``belief.physical()`` those of the prior's ``step``.

    ## Action space, observation space

    As `DuffingEnv`.

    ## Reward

    ``information_gain`` (default), ``expected_free_energy`` or ``free_energy``, as `DuffingEnv`. The others compare
    with the true oscillator, which nobody knows: they are refused.

    ## Starting state

    What ``plant.reset()`` leaves. The posterior is the prior. That of Amplitude-v0, the default, expects an oscillator
    at rest, with parameters within ±30 % of the Silverbox circuit's twin; another plant needs another ``prior``.

    ## Episode end

    - Termination: \|y\| > ``max_output``; or a plant that raises an exception or gives something that is not a finite
      number (``info["diverged"]``), which leaves the belief as it was before that step.
    - Truncation: after ``horizon`` (256) samples.

    An exception in ``plant.reset()`` comes out of ``reset``, and no episode has begun.

    ## Information

    ``information_gain`` [nats] and ``diverged`` at every step; at the end of an episode ``belief``, and ``plant_error``
    where the plant raised: the exception's type and message. There is no ``log_posterior_gain`` and no ``truth``:
    ``env.unwrapped.truth`` raises AttributeError. The rendered picture shows deviations from the twin.

    ## Arguments

    ``factorisation``, ``iterations``, ``noise_hypotheses``, ``max_input``, ``max_output``, ``hold``, ``terminal``,
    ``terminated_return`` and ``render_mode`` as `DuffingEnv`. With ``hold`` the plant's ``step`` is called for every
    sample, with the same input.

    | Argument | Default | Meaning |
    |----------|---------|---------|
    | ``plant`` | | the plant; it stays the caller's, who closes it |
    | ``reward`` | ``information_gain`` | or ``expected_free_energy``, ``free_energy`` |
    | ``horizon`` | 256 | samples of an episode |
    | ``prior`` | None | an `estimator.Belief`, whose model is then believed; None: that of Amplitude-v0 |

    A plant and a prior are Python objects, so the specification of an environment made with them is not JSON-able; and
    an environment is copied and pickled with its plant, if the plant can be. One plant is one environment: `make_vec`
    is refused, because its environments would share it.

    >>> import gymnasium as gym
    >>> import duffing_env
    >>> class Difference:
    ...     def reset(self):
    ...         self.x = self.last = 0.0
    ...     def step(self, u):
    ...         self.x, self.last = 1.5 * self.x - 1.4 * self.x**3 - 0.95 * self.last + 0.4 * u, self.x
    ...         return self.x
    >>> env = gym.make("duffing_env/Plant-v0", plant=Difference())
    >>> observation, info = env.reset(seed=0)
    >>> done = False
    >>> while not done:
    ...     action = [1.0 if observation[18] <= 0 else -1.0]  # to and fro
    ...     observation, reward, terminated, truncated, info = env.step(action)
    ...     done = terminated or truncated
    >>> sorted(info), truncated
    (['belief', 'diverged', 'information_gain'], True)
    >>> bool(abs(info["belief"].coefficients_mean[3] - 0.4) < 0.01)
    True

    ## Version history

    * v0: initial version
    """

    experiment_kind: ClassVar[type[Experiment]] = PlantExperiment
    _reported: ClassVar[tuple[str, ...]] = ("information_gain",)

    def __init__(self, plant: Plant, *, render_mode: str | None = None, **options: Any) -> None:
        for method in ("reset", "step"):
            if not callable(getattr(plant, method, None)):
                raise ValueError(f"plant must have methods reset() and step(u), but {plant!r} has no {method}()")
        super().__init__(render_mode=render_mode, **options)
        self.plant = plant
        self._plant_error: str | None = None
        # A plant would wait for the compiler with its first input on.
        self._batch.step(0.0)

    @property
    def truth(self) -> Parameters:
        """The plant's true parameters are not known.

        Raises:
            AttributeError: always.
        """
        raise AttributeError("nobody knows the true parameters of a plant of one's own; ask for env.unwrapped.belief")

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Bring the plant to rest and start an episode; ``options`` has no keys, and the plant is not told the seed."""
        self._running = False
        self.plant.reset()
        return super().reset(seed=seed, options=options)

    def _apply(self, action: float) -> None:
        scales = self.experiment.scales
        u = self.max_input * float(np.float32(action))
        self._plant_error = None
        try:
            y = float(self.plant.step(scales.input * u)) / scales.output
        except Exception as error:  # whatever it is: the episode ends in order, and its belief is told
            self._plant_error = f"{type(error).__name__}: {error}"
            y = np.nan
        self._batch.measure(u, y)
        self._batch.step(action)

    def _final_info(self) -> dict[str, Any]:
        failure = {} if self._plant_error is None else {"plant_error": self._plant_error}
        return {"belief": self.belief, **failure}


def refuse_vector(*args: Any, **kwargs: Any) -> None:
    """What `gymnasium.make_vec` gets for this track: it would pass the one plant to all environments.

    Raises:
        ValueError: always, with the remedy.
    """
    raise ValueError(
        "one plant is one environment, and make_vec would share it; for several plants use "
        "gymnasium.vector.SyncVectorEnv([lambda: PlantEnv(plant_1), lambda: PlantEnv(plant_2), ...])"
    )
