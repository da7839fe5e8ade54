"""The reward ``expected_free_energy``: expected information gains against achieved ones."""

import gymnasium as gym
import numpy as np
import pytest

SYSTEMS, SAMPLES = 256, 256


def sums(track="duffing_env/Amplitude-v0", systems=SYSTEMS, samples=SAMPLES, **options):
    """Cumulative expected and achieved gains (samples, systems) under uniform inputs; NaN after the end."""
    options = {"reward": "expected_free_energy", **options}
    envs = gym.make_vec(track, num_envs=systems, vectorization_mode="vector_entry_point", **options)
    envs.reset(seed=0)
    rng, running = np.random.default_rng(0), np.ones(systems, dtype=bool)
    promised, gained = np.full((2, samples, systems), np.nan)
    for t in range(samples):
        actions = rng.uniform(-1, 1, (systems, 1)).astype(np.float32)
        _, rewards, terminated, truncated, infos = envs.step(actions)
        promised[t, running], gained[t, running] = rewards[running], infos["information_gain"][running]
        running &= ~(terminated | truncated)
    return promised, gained


EQUATION_1 = "duffing_env/Amplitude-v1"
KNOWN = {
    "noise_range": 1.0,
    "noise_hypotheses": 1,
    "noise_shape": 1e9,
    "horizon": 60,
}  # noises that are known, so that no outcome changes what it tells


@pytest.mark.parametrize(
    ("track", "options"),
    [
        ("duffing_env/Amplitude-v0", {}),
        (EQUATION_1, {}),
        # seconds of compilation for another combination
        pytest.param(EQUATION_1, {"estimator": "nlarx"}, marks=pytest.mark.slow),
        (EQUATION_1, {"max_slew": 0.02}),
    ],
)
def test_the_expected_gain_is_achieved_where_the_noises_are_known(track, options):
    promised, gained = sums(track, 8, 60, **KNOWN, **options)
    seen = ~np.isnan(promised)
    assert seen.sum() > 300
    assert promised[seen].max() > 0.1
    np.testing.assert_allclose(promised[seen], gained[seen], rtol=0, atol=1e-6)


def test_the_expected_gain_counts_again_what_drift_destroyed():
    promised, gained = sums(systems=8, samples=60, drift=0.01, **KNOWN)
    assert (promised[~np.isnan(promised)] >= 0).all()
    assert np.nansum(promised) > np.nansum(gained) + 8 * 0.5  # the same information is paid again


def test_expected_gains_are_achieved_on_average_by_calibrated_beliefs():
    promised, gained = (np.nansum(column, axis=0) for column in sums())
    assert promised.mean() == pytest.approx(17.79, abs=0.01)  # the figures of `duffing_env.rewards.named_rewards`
    assert abs((promised - gained).mean()) < 0.05


@pytest.mark.slow  # slow for the reason at `test_kernel.PAIRS`
def test_expected_gains_are_not_achieved_by_a_mean_field():
    promised, gained = (np.nansum(column, axis=0) for column in sums(factorisation="mean_field"))
    assert promised.mean() == pytest.approx(10.9, abs=0.05)
    assert gained.mean() == pytest.approx(16.5, abs=0.05)
