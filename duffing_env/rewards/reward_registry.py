"""The rewards by name. What each is worth, and how it can be fooled, stands here; the kernel computes them.

- ``information_gain``: entropy decrease of q(θ, η) in nats: ½ log det C_{t-1} - ½ log det C_t. What the estimator
  believes it learned. Equals the true information gain only where the posterior is calibrated (structured); an
  over-confident one (mean field) pays for its own mistakes.
- ``log_posterior``: increase of log q(θ, η) at the true coefficients, in nats. Its expected sum is a lower bound on the
  expected information gain, whatever q is: over-confidence lowers it. Needs the truth, so it is for training and for
  tests.
- ``parameter_error``: decrease of the mean relative error of the estimates of m, c, a and b, each error capped at 1; an
  episode's sum lies in [-1, 1]. Noisy: the error of one estimate is one draw of what its posterior describes.
- ``fisher``: increase of ½ log det(Λ0 + F), F the Fisher information of the outputs at the true coefficients and Λ0 the
  prior's precision: what an efficient estimator would gain. Needs the truth, so it is for training and for tests; no
  estimator can talk it up (`duffing_env.rewards.fisher_reward`).
- ``expected_free_energy``: minus the expected free energy of the input that was chosen, in nats: the information about
  (θ, η) that the sample was expected to give by the belief before it, -½ log(1 - cᵀ C⁻¹ c / S), with C the
  coefficients' covariance, S the variance of the output and c its covariance with them (`duffing_env.rewards.expected_free_energy_reward`).
  There is no goal prior, so nothing pragmatic; ``input_cost`` is the prior on the input. Never negative, and free of
  the outcome's noise. By the chain rule of information its mean over episodes is that of the information gain, if the
  belief is the exact posterior: 17.79 nats beside 17.79 with uniform inputs on Amplitude-v0, structured. It bounds
  nothing by itself: it is what the belief promises. A promise that is not kept is made, and paid, again: whoever keeps
  the posterior wide is paid most. So a belief that contracts more than it promised is paid too little (mean field:
  10.9 nats promised, 16.5 claimed), one that is widened between samples (``drift``) for the same knowledge again and
  again, and inputs for which the linearisation promises what the update does not keep are worth looking for.
- ``simulation_error``: decrease of the error of a free run: the posterior mean's oscillator beside the true one, both
  from rest, over a fixed multisine of 64 samples (`duffing_env.rewards.simulation_error_reward`); RMS of the difference over that of the
  true run, capped at 1, so an episode's sum lies in [-1, 1]. It counts the parameters by what they do to the output,
  so those that do little there may stay wrong: the test input has half of ``max_input``, and what only shows beyond is
  not seen. Noisy as the parameter error is, and flat where the error is above the cap. Needs the truth.
- ``free_energy``: minus the free energy of the sample in nats: how well the output was predicted. Rewards inputs whose
  outcome is known already, so an agent that maximises it learns nothing; the foil.

Information gain, log posterior, parameter error and simulation error telescope: an episode's sum depends on its first
and last belief only. So does the Fisher information, on its first and last matrix.

A reward is a function of what the sample changed, compiled into the kernel (`Reward`); some need work of their own, in
hooks. To add one, add it to `REWARDS`.

Three options go with every reward:

- ``input_cost`` takes its part off for every sample.
- ``terminal=True`` pays the episode's whole sum in its last step, and 0 before. Without discount the return is the
  same; what is lost is the hint which input earned it.
- ``terminated_return`` is the return of an episode that ends by termination: its last reward takes back what was
  received and gives this number. Without it what was gained before the end is kept, which is right for an experiment
  that is over, and wrong where the end stands for damage: on Amplitude-v0 pushing along the velocity until the limit
  ends the episode gains 15.2 nats, no input at all 2.4. And where ``max_output`` lets the explicit plant blow up, its
  powers tell the coefficients to many digits: 23.5 nats at a limit of 1 kV. That is the plant's failure, and no
  experiment. With ``terminated_return=-10`` such inputs return less than none, whatever the reward. A number below
  what no input returns will do; it is for a discount of 1.

The figures of uniform inputs are those of tests/duffing_env/test_expectation.py, those of inputs that pump of
tests/duffing_env/test_blow_up.py.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from duffing_env.rewards import (
    expected_free_energy_reward,
    fisher_reward,
    free_energy_reward,
    simulation_error_reward,
)
from duffing_env.rewards.reward_hooks import NO_HOOKS, RewardHooks
from duffing_env.storage.kernel_spec import KernelSpec
from estimator.support.argument_checks import did_you_mean


@dataclass(frozen=True)
class Reward:
    """A reward that the kernel computes: a weighted sum of four terms, one of which is a reward's own work.

    Attributes:
        weights: of what a sample gave: the decrease of entropy, the increase of the log posterior at the truth [nats],
            the decrease of the parameters' error, and row ``WORK``, which the hooks leave.
        needs_truth: whether it compares with the true plant.
        compile_hooks: ``compile_hooks(spec, generated)`` makes the hooks, of the functions that are generated for an
            environment (`duffing_env.kernel_stages.env_codegen`); None for a reward without hooks.
        hook_source: ``hook_source(spec, loop)`` is the source of what the hooks need among these functions, by the loop
            printer of `duffing_env.kernel_stages.env_codegen`; None where they need nothing.
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
    """What the kernel computes of a reward: of a function of one's own nothing."""
    return Reward((0.0, 0.0, 0.0, 0.0)) if callable(reward) else REWARDS[reward]


def check_reward(reward: str | Callable[..., Any]) -> None:
    """ValueError for an unknown name."""
    if not callable(reward) and not (isinstance(reward, str) and reward in REWARDS):
        raise ValueError(
            f"reward must be one of {list(REWARDS)} or a function, but is {reward!r}{did_you_mean(reward, REWARDS)}"
        )
