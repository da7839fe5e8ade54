"""The tracks on the paper's equation with a short horizon, an input budget, an output limit or a jumping mass."""

from __future__ import annotations

from duffing_env.env import DuffingEnv


class ShortEnv(DuffingEnv):
    """Identify the oscillator within 48 samples: 79 ms, some five periods of its resonance.

    ## Description

    As `DuffingEnv`, but ``horizon`` is 48, after which an episode is truncated: every sample counts, and the posterior
    is still wide when the best inputs must be chosen. An episode gains about 16 nats of information.

    >>> import gymnasium as gym
    >>> env = gym.make("duffing_env/Short-v0")
    >>> observation, info = env.reset(seed=0)
    >>> sum(not any(env.step([1.0])[2:4]) for _ in range(47))
    47

    ## Version history

    * v0: initial version
    """


class PowerEnv(DuffingEnv):
    """Identify the oscillator with an input of at most 22.2 mV RMS, as the Silverbox multisine has.

    ## Description

    As `DuffingEnv`, but the input has a budget: over an episode its root mean square is at most ``max_rms``, so its
    energy Σ u² is at most ``horizon * max_rms**2``. An input beyond the rest of the budget is cut,
    |u_t| ≤ sqrt(budget - spent), so the budget is never exceeded, and the input is zero when nothing is left. Inputs of
    0.15 V spend it in 5 samples; the task is when to spend it.

    The action is the requested input; observation 18 is the applied input, observation 21 the part of the energy that
    is left. ``max_rms`` is 0.0222. An episode gains 9 to 16 nats of information.

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
    r"""Identify the oscillator within \|y\| ≤ 0.3 V, the output range of the real circuit.

    ## Description

    As `DuffingEnv`, but ``max_output`` is 0.3: an episode is terminated at half the displacement, which also scales the
    observed state and output. Driven at resonance by the largest input, the oscillator reaches the limit within a
    period and a half, so the input must be cautious.

    ## Version history

    * v0: initial version
    """


class DriftEnv(DuffingEnv):
    """Follow an oscillator whose mass jumps once, at an unknown sample.

    ## Description

    As `DuffingEnv`, but over a ``horizon`` of 512 samples, and at a sample uniform over the middle half of the episode
    the mass is multiplied by a factor log-uniform on 1 ± ``jump`` (0.3; below 1). The estimator expects change: before
    every sample a random walk widens each coefficient's posterior, by a standard deviation of ``drift`` (0.01) times
    the prior's, so it forgets in several hundred samples. Its intervals hold for a walk; a jump is a large step of it.

    Only the outputs show the jump to the agent. At the end ``env.unwrapped.truth`` is the oscillator after the jump.

    ## Reward

    The posterior widens between samples, so the ``information_gain`` of a step can be negative; its sum over an episode
    is the knowledge at the end. ``log_posterior`` and ``parameter_error`` refer to the oscillator at that sample and do
    not count their change by the jump itself. So they pay again for every belief that has to be unlearned, the more the
    surer it was, and are no rewards to train with here. With ``terminated_return=0`` an end before the jump gains
    nothing.

    ## Policies

    Gains on 128 systems of the branch ``test``; the page Training has the command, and more.

    | policy | ``information_gain`` / nat |
    |---|---|
    | a script: wait for 390 samples, then `efe` | 14.37 |
    | `ppo/drift` | 13.78 |
    | `efe` from the start | 12.69 |

    ## Version history

    * v0: initial version
    """
