"""The tracks that differ from `DuffingEnv` by their limits, or by an oscillator that changes."""

from __future__ import annotations

from duffing_env.env import DuffingEnv


class ShortEnv(DuffingEnv):
    """Identify the oscillator within 48 samples: 79 ms, some five periods of its resonance.

    ## Description

    As `DuffingEnv` in all, but ``horizon`` is 48, after which an episode is truncated: every sample counts, and the
    posterior is still wide when the best inputs must be chosen. The information gained over an episode is about 16
    nats.

    >>> import gymnasium as gym
    >>> env = gym.make("duffing_env/Short-v0")
    >>> observation, info = env.reset(seed=0)
    >>> sum(not any(env.step([1.0])[2:4]) for _ in range(47))
    47

    ## Version history

    * v0: initial version
    """


class PowerEnv(DuffingEnv):
    """Identify the oscillator with an input of at most 22.2 mV RMS, that of the Silverbox multisine.

    ## Description

    As `DuffingEnv` in all, but the input has a budget: over an episode its root mean square is at most ``max_rms``, so
    its energy Σ u² is at most ``horizon * max_rms**2``. An input that what is left of the budget cannot pay for is cut
    to what it can: |u_t| ≤ sqrt(budget - spent), so the budget is never exceeded, and an input of zero follows when
    nothing is left. Spent all at once at 0.15 V it lasts for 5 samples; when to spend it is the question.

    The action is the input that is asked for; observation 18 is the input that was given, observation 21 the part of
    the energy that is left. ``max_rms`` is 0.0222. The information gained over an episode is 9 to 16 nats.

    >>> import gymnasium as gym
    >>> env = gym.make("duffing_env/Power-v0")
    >>> observation, info = env.reset(seed=0)
    >>> for _ in range(7):
    ...     observation, *_ = env.step([1.0])
    >>> float(observation[18]), float(observation[21])
    (0.0, 0.0)

    ## Version history

    * v0: initial version
    """


class OutputEnv(DuffingEnv):
    r"""Identify the oscillator without leaving \|y\| ≤ 0.3 V, the range seen on the real circuit.

    ## Description

    As `DuffingEnv` in all, but ``max_output`` is 0.3: the episode is terminated at half the displacement, in parts of
    which the state and the output are observed. Driven at its resonance by the largest input, the oscillator gets there
    within a period and a half, so the input must feel its way.

    ## Version history

    * v0: initial version
    """


class DriftEnv(DuffingEnv):
    """Follow an oscillator whose mass jumps once, at an unknown sample.

    ## Description

    As `DuffingEnv`, but over a ``horizon`` of 512 samples, and at a sample that is uniform over the middle half of the
    episode the mass is multiplied by a factor that is log-uniform on 1 ± ``jump`` (0.3; below 1). The estimator
    expects change: before every sample each coefficient's standard deviation is widened as by a random walk, ``drift``
    (0.01) of that of the prior, so it forgets in several hundred samples. Its intervals are those of a walk; a jump
    is a large step of it.

    The agent is not told of the jump; it shows in the outputs. At the end ``env.unwrapped.truth`` is the oscillator
    after it. All that is not said here is as in `DuffingEnv`.

    ## Reward

    The posterior widens between samples, so the ``information_gain`` of a step can be negative;
    ``log_posterior`` and ``parameter_error`` are those of the oscillator as it is at that sample, and what the jump
    itself does to them is not counted: they are set anew with the new mass. So they pay again for what was believed
    and has to be unlearned, the more the surer it was, and are no rewards to train with here. Of ``information_gain``
    only what is known at the end is left over an episode; with ``terminated_return=0`` nothing is gained by ending it
    before the jump.

    ## Policies

    What they gain, on 128 systems of the branch ``test``. Training has the command, and more.

    | policy | ``information_gain`` / nat |
    |---|---|
    | a script: wait for 390 samples, then `efe` | 14.37 |
    | `ppo/drift` | 13.78 |
    | `efe` from the start | 12.69 |

    ## Version history

    * v0: initial version
    """
