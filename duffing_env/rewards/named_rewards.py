"""The rewards by name, with the meaning of each and the inputs that exploit it; the kernel computes them.

- ``information_gain``: entropy decrease of q(θ, η) in nats: ½ log det C_{t-1} - ½ log det C_t, the gain by the
  estimator's own belief. It equals the true information gain only where the posterior is calibrated (structured); an
  over-confident posterior (mean field) is paid for its mistakes.
- ``log_posterior``: increase of log q(θ, η) at the true coefficients, in nats. For any q its expected sum is a lower
  bound on the expected information gain: over-confidence lowers it. It needs the truth, so it is for training and
  tests.
- ``parameter_error``: decrease of the mean relative error of the estimates of m, c, a and b, each error capped at 1; an
  episode's sum lies in [-1, 1]. It is noisy: the error of one estimate is one draw from its posterior.
- ``fisher``: increase of ½ log det(Λ0 + F), the gain of an efficient estimator, with the Fisher information F of the
  outputs at the true coefficients and the prior's precision Λ0. It needs the truth, so it is for training and tests; no
  belief changes it (`duffing_env.rewards.fisher_reward`).
- ``expected_free_energy``: minus the expected free energy of the chosen input, in nats: the expected information of the
  sample about (θ, η) under the belief before it, -½ log(1 - cᵀ C⁻¹ c / S), with the coefficients' covariance C, the
  variance S of the output and the covariance c of the two (`duffing_env.rewards.expected_free_energy_reward`). There is
  no goal prior, so there is no pragmatic term; ``input_cost`` is the prior on the input. The reward is never negative,
  and free of the outcome's noise. By the chain rule of information its mean over episodes equals the mean information
  gain if the belief is the exact posterior: both are 17.79 nats with uniform inputs on Amplitude-v0, structured. It is
  no bound: an expectation that the update does not meet is paid again at the next sample, so a posterior that stays
  wide is paid most. A belief that contracts more than expected is paid too little (mean field: 10.9 nats expected, 16.5
  claimed). A belief that ``drift`` widens between samples is paid for the same knowledge again and again. Inputs for
  which the linearisation expects more than the update gains are paid too much.
- ``simulation_error``: decrease of the error of a free run: the oscillator of the posterior mean beside the true one,
  both from rest, over a fixed multisine of 64 samples (`duffing_env.rewards.simulation_error_reward`). The error is the
  RMS of the difference over the RMS of the true run, capped at 1, so an episode's sum lies in [-1, 1]. It weighs the
  parameters by their effect on the output: the test input has half of ``max_input``, and parameters that act beyond it
  may stay wrong. It is noisy as the parameter error is, and flat where the error exceeds the cap. It needs the truth.
- ``free_energy``: minus the free energy of the sample in nats: how well the output was predicted. It rewards inputs
  with a known outcome, so an agent that maximises it learns nothing; it is a foil.

Information gain, log posterior, parameter error and simulation error telescope: an episode's sum depends on its first
and last belief only, and the sum of ``fisher`` on its first and last matrix.

A reward is a weighted sum of four terms that the kernel computes (`Reward`); the hooks of a reward compute the fourth.
To add a reward, add it to `REWARDS`.

Three options go with every reward:

- ``input_cost`` takes the cost of the input off every sample's reward.
- ``terminal=True`` pays the episode's whole sum in its last step, and 0 before. Without discount the return is the
  same, but no reward shows which input earned it.
- ``terminated_return`` is the return of an episode that ends by termination: its last reward takes back all that was
  paid and pays this number. Without it the gain before the end is kept. That is right for an experiment that is over,
  and wrong where the end stands for damage: on Amplitude-v0 an input along the velocity up to the limit gains
  15.2 nats, and no input at all 2.4. And where ``max_output`` lets the explicit plant blow up, its large outputs give
  the coefficients to many digits: 23.5 nats at a limit of 1 kV, by the plant's failure and not by an experiment. With
  ``terminated_return=-10`` such inputs return less than no input, whatever the reward. Any number below the return of
  no input will do, for a discount of 1.

The figures of uniform inputs are from tests/duffing_env/test_expectation.py, and the figures of inputs along the
velocity from tests/duffing_env/test_blow_up.py.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from duffing_env.rewards import expected_free_energy_reward, fisher_reward, free_energy_reward, simulation_error_reward
from duffing_env.rewards.reward_hooks import NO_HOOKS, RewardHooks
from duffing_env.storage.kernel_spec import KernelSpec
from estimator.support.argument_checks import did_you_mean


@dataclass(frozen=True)
class Reward:
    """A reward that the kernel computes: a weighted sum of four terms of a sample.

    Attributes:
        weights: weights of the decrease of entropy [nats], the increase of the log posterior at the truth [nats], the
            decrease of the parameter error, and row ``HOOK_REWARD``, which the hooks write.
        needs_truth: whether it compares with the true plant.
        compile_hooks: ``compile_hooks(spec, generated)`` makes the hooks, of the functions that are generated for an
            environment (`duffing_env.kernel_stages.generated_environment_functions`); None for a reward without hooks.
        hook_source: ``hook_source(spec, loop)`` is the source of what the hooks need among these functions, by the loop
            printer of `duffing_env.kernel_stages.generated_environment_functions`; None where they need nothing.
    """

    weights: tuple[float, float, float, float]
    needs_truth: bool = False
    compile_hooks: Callable[[KernelSpec, Any], RewardHooks] | None = None
    hook_source: Callable[[KernelSpec, Any], str] | None = None


_HOOK_WEIGHTS = (0.0, 0.0, 0.0, 1.0)


#: The rewards by name.
REWARDS = {
    "information_gain": Reward((1.0, 0.0, 0.0, 0.0)),
    "log_posterior": Reward((0.0, 1.0, 0.0, 0.0), needs_truth=True),
    "parameter_error": Reward((0.0, 0.0, 1.0, 0.0), needs_truth=True),
    "free_energy": Reward(_HOOK_WEIGHTS, False, free_energy_reward.compile_hooks),
    "fisher": Reward(_HOOK_WEIGHTS, True, fisher_reward.compile_hooks, fisher_reward.hook_source),
    "expected_free_energy": Reward(
        _HOOK_WEIGHTS, False, expected_free_energy_reward.compile_hooks, expected_free_energy_reward.hook_source
    ),
    "simulation_error": Reward(
        _HOOK_WEIGHTS, True, simulation_error_reward.compile_hooks, simulation_error_reward.hook_source
    ),
}


def compile_reward_hooks(spec: KernelSpec, generated: Any) -> RewardHooks:
    """The hooks of a kind of experiment, of the functions that are generated for it."""
    compile_hooks = REWARDS[spec.reward_hooks].compile_hooks if spec.reward_hooks else None
    return compile_hooks(spec, generated) if compile_hooks else NO_HOOKS


def kernel_reward(reward: str | Callable[..., Any]) -> Reward:
    """The reward that the kernel computes: all weights are 0 for a function of the user."""
    return Reward((0.0, 0.0, 0.0, 0.0)) if callable(reward) else REWARDS[reward]


def check_reward(reward: str | Callable[..., Any]) -> None:
    """Refuse a reward that is neither a known name nor a function.

    Raises:
        ValueError: with the known names.
    """
    if not callable(reward) and not (isinstance(reward, str) and reward in REWARDS):
        raise ValueError(
            f"reward must be one of {list(REWARDS)} or a function, but is {reward!r}{did_you_mean(reward, REWARDS)}"
        )
