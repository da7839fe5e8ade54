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
  estimator can talk it up (`duffing_env.fisher`).
- ``expected_free_energy``: minus the expected free energy of the input that was chosen, in nats: the information about
  (θ, η) that the sample was expected to give by the belief before it, -½ log(1 - cᵀ C⁻¹ c / S), with C the
  coefficients' covariance, S the variance of the output and c its covariance with them (`duffing_env.expectation`).
  There is no goal prior, so nothing pragmatic; ``input_cost`` is the prior on the input. Never negative, and free of
  the outcome's noise. By the chain rule of information its mean over episodes is that of the information gain, if the
  belief is the exact posterior: 17.79 nats beside 17.79 with uniform inputs on Amplitude-v0, structured. It bounds
  nothing by itself: it is what the belief promises. A promise that is not kept is made, and paid, again: whoever keeps
  the posterior wide is paid most. So a belief that contracts more than it promised is paid too little (mean field:
  10.9 nats promised, 16.5 claimed), one that is widened between samples (``drift``) for the same knowledge again and
  again, and inputs for which the linearisation promises what the update does not keep are worth looking for.
- ``simulation_error``: decrease of the error of a free run: the posterior mean's oscillator beside the true one, both
  from rest, over a fixed multisine of 64 samples (`duffing_env.simulation`); RMS of the difference over that of the
  true run, capped at 1, so an episode's sum lies in [-1, 1]. It counts the parameters by what they do to the output,
  so those that do little there may stay wrong: the test input has half of ``max_input``, and what only shows beyond is
  not seen. Noisy as the parameter error is, and flat where the error is above the cap. Needs the truth.
- ``free_energy``: minus the free energy of the sample in nats: how well the output was predicted. Rewards inputs whose
  outcome is known already, so an agent that maximises it learns nothing; the foil.

Information gain, log posterior, parameter error and simulation error telescope: an episode's sum depends on its first
and last belief only. So does the Fisher information, on its first and last matrix.

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

import difflib

from duffing_env.layout import LAYOUT, OUTCOME
from estimator.elementary import log
from estimator.lanes import at_lane, inlined, lanewise

# Where `log` ends: below, numbers lose digits.
_SMALLEST, _INFINITE = 2.0**-1022, float("inf")

#: Name of a reward to its number in the kernel.
REWARDS = {
    "information_gain": 0,
    "log_posterior": 1,
    "parameter_error": 2,
    "free_energy": 3,
    "fisher": 4,
    "expected_free_energy": 5,
    "simulation_error": 6,
}

#: Rewards that compare the belief with the true oscillator, or need it to be told.
NEED_THE_TRUTH = ("log_posterior", "parameter_error", "fisher", "simulation_error")


def reward_number(name: str) -> int:
    """The kernel's number of a reward; ValueError for an unknown name."""
    if name not in list(REWARDS):
        near = difflib.get_close_matches(str(name), REWARDS, 1)
        hint = f"; did you mean {near[0]!r}?" if near else ""
        raise ValueError(f"reward must be one of {list(REWARDS)}, but is {name!r}{hint}")
    return REWARDS[name]


@inlined
def log_det_and_density(t1, t2, t3, e, P, true_t1, true_t2, true_t3, true_e, nonlinear):
    """Log det of the coefficients' covariance, and log density at the true ones, by an L D Lᵀ factorisation.

    The order is θ1, θ3, η, θ2, so that a θ2 known to be zero is left out by leaving out the last pivot. ``sound``
    says that all pivots are positive, and their product a number that has a logarithm.
    """
    P_t1_t1, P_t1_t2, P_t1_t3, P_t1_e, P_t2_t2, P_t2_t3, P_t2_e, P_t3_t3, P_t3_e, P_e_e = P
    d1 = P_t1_t1
    l31, le1, l21 = P_t1_t3 / d1, P_t1_e / d1, P_t1_t2 / d1
    d3 = P_t3_t3 - l31 * P_t1_t3
    w_e3 = P_t3_e - le1 * P_t1_t3
    w_23 = P_t2_t3 - l21 * P_t1_t3
    le3, l23 = w_e3 / d3, w_23 / d3
    de = P_e_e - le1 * P_t1_e - le3 * w_e3
    w_2e = P_t2_e - l21 * P_t1_e - l23 * w_e3
    l2e = w_2e / de
    d2 = P_t2_t2 - l21 * P_t1_t2 - l23 * w_23 - l2e * w_2e
    z1 = true_t1 - t1
    z3 = true_t3 - t3 - l31 * z1
    ze = true_e - e - le1 * z1 - le3 * z3
    z2 = true_t2 - t2 - l21 * z1 - l23 * z3 - l2e * ze
    d2 = d2 if nonlinear else 1.0
    z2 = z2 if nonlinear else 0.0
    determinant = d1 * d3 * de * d2
    sound = d1 > 0.0 and d3 > 0.0 and de > 0.0 and d2 > 0.0 and _SMALLEST < determinant < _INFINITE
    log_det = log(determinant)
    return log_det, -0.5 * (log_det + z1 * z1 / d1 + z2 * z2 / d2 + z3 * z3 / d3 + ze * ze / de), sound


@inlined
def _relative_error(t1, t2, t3, e, m, c, a, b, step, continuous):
    """Mean relative error of the estimates of m, c, a, b, each capped at 1.

    By Eq. (4); for the physical equation m = δ²/gain, c = δ damping/gain, a = stiffness/gain, b = cubic/gain.
    """
    weight = 1.0 / e
    inertia = 1.0 if continuous else -t3
    damping = t3 if continuous else 1.0 + t3
    stiffness = t1 if continuous else 1.0 - t1 - t3
    cubic = t2 if continuous else -t2
    return 0.25 * (
        _capped(inertia * step * step * weight / m)
        + _capped(damping * step * weight / c)
        + _capped(stiffness * weight / a)
        + _capped(cubic * weight / b)
    )


@inlined
def _capped(ratio):
    deviation = abs(ratio - 1.0)
    return deviation if deviation < 1.0 else 1.0


@lanewise(
    LAYOUT,
    " ".join(OUTCOME) + " log_det log_density error elapsed",
    uniform="max_output horizon step nonlinear continuous reward_kind input_cost",
)
def settle(
    x0, x1, x2, t1, t2, t3, e, P_x0_x0, P_x1_x1, P_x2_x2,
    P_t1_t1, P_t1_t2, P_t1_t3, P_t1_e, P_t2_t2, P_t2_t3, P_t2_e, P_t3_t3, P_t3_e, P_e_e,
    g_rate, n_rate, m, c, a, b, true_t1, true_t2, true_t3, true_e,
    u, x, y, elapsed, log_det, log_density, error, misfit, surprise, fisher_gain, off_record,
    max_output, horizon, step, nonlinear, continuous, reward_kind, input_cost,
):  # fmt: skip
    """What the step was worth, and whether the episode ends.

    A number that is not finite ends it, flagged, and so does a covariance that is not positive definite any more.
    ``surprise`` is the free energy of the sample, or the expected one, where that is the reward, and 0 elsewhere; so
    are ``fisher_gain`` and ``misfit``.
    """
    P = (P_t1_t1, P_t1_t2, P_t1_t3, P_t1_e, P_t2_t2, P_t2_t3, P_t2_e, P_t3_t3, P_t3_e, P_e_e)
    new_log_det, new_log_density, sound = log_det_and_density(
        t1, t2, t3, e, P, true_t1, true_t2, true_t3, true_e, nonlinear != 0.0
    )  # fmt: skip
    new_error = _relative_error(t1, t2, t3, e, m, c, a, b, step, continuous != 0.0)
    if reward_kind == 6.0:
        new_error = misfit
    total = x + y + x0 + x1 + x2 + t1 + t2 + t3 + e + P_x0_x0 + P_x1_x1 + P_x2_x2 + g_rate + n_rate
    total += new_log_density + new_error + surprise
    sound = sound and P_x0_x0 > 0.0 and P_x1_x1 > 0.0 and g_rate > 0.0 and n_rate > 0.0
    diverged = 0.0 if (total - total == 0.0 and sound) else 1.0
    void = diverged != 0.0 or off_record != 0.0
    new_log_det = log_det if void else new_log_det
    new_log_density = log_density if void else new_log_density
    new_error = error if void else new_error
    fisher_gain = 0.0 if void else fisher_gain
    information_gain = 0.5 * (log_det - new_log_det)
    log_posterior_gain = new_log_density - log_density
    reward = information_gain
    if reward_kind == 1.0:
        reward = log_posterior_gain
    if reward_kind == 2.0 or reward_kind == 6.0:
        reward = error - new_error
    if reward_kind == 3.0 or reward_kind == 5.0:
        reward = 0.0 if void else -surprise
    if reward_kind == 4.0:
        reward = fisher_gain
    reward -= input_cost * u * u
    terminated = 1.0 if (void or abs(y) > max_output) else 0.0
    elapsed += 1.0
    truncated = 1.0 if (elapsed >= horizon and terminated == 0.0) else 0.0
    return (
        reward, information_gain, log_posterior_gain, terminated, truncated, diverged, off_record,
        new_log_det, new_log_density, new_error, elapsed,
    )  # fmt: skip


@lanewise(LAYOUT, "reward earned", uniform="terminal forfeits terminated_return")
def pay(reward, earned, terminated, truncated, terminal, forfeits, terminated_return):
    """When the reward is paid, and what an episode that is terminated returns.

    ``earned`` is what the episode was worth so far, as if it were paid sample by sample.
    """
    received = 0.0 if terminal != 0.0 else earned
    earned += reward
    if terminal != 0.0:
        reward = earned if terminated + truncated != 0.0 else 0.0
    if forfeits != 0.0 and terminated != 0.0:
        reward = terminated_return - received
    return reward, earned


@at_lane(LAYOUT, "log_det log_density error", uniform="step nonlinear continuous")
def appraise(
    t1, t2, t3, e, P_t1_t1, P_t1_t2, P_t1_t3, P_t1_e, P_t2_t2, P_t2_t3, P_t2_e, P_t3_t3, P_t3_e, P_e_e,
    m, c, a, b, true_t1, true_t2, true_t3, true_e, step, nonlinear, continuous,
):  # fmt: skip
    """Log det, log density and error of a lane's belief beside its oscillator, where either is new."""
    P = (P_t1_t1, P_t1_t2, P_t1_t3, P_t1_e, P_t2_t2, P_t2_t3, P_t2_e, P_t3_t3, P_t3_e, P_e_e)
    log_det, log_density, _ = log_det_and_density(t1, t2, t3, e, P, true_t1, true_t2, true_t3, true_e, nonlinear != 0.0)
    return log_det, log_density, _relative_error(t1, t2, t3, e, m, c, a, b, step, continuous != 0.0)
