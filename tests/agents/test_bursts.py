"""Bursts against plain NumPy, what they are worth, and how hard policies push beside them."""

import numpy as np
import pytest

from agents.evaluation.batch import TESTED, make
from agents.planner.motion import View
from agents.policies import make_policy
from agents.policies.bursts import burster, drawn
from agents.policies.foresight import CommonForesight
from agents.policies.imagined import FEATURES
from agents.policies.sight import Sight
from estimator.belief import covariance_places
from estimator.models.difference import difference

TRACK = "duffing_env/Power-v0"


def begun(samples, options=None, count=6):
    """Environments some samples into their episodes, and what they show."""
    envs = make(TRACK, count, {"horizon": 40, **(options or {})})
    rng = np.random.default_rng(5)
    observations, _ = envs.reset(seed=2)
    for _ in range(samples):
        observations, *_ = envs.step(rng.choice([-0.2, 0.0, 0.2], (count, 1)).astype(np.float32))
    return envs, observations


def found(envs, observations, terms):
    pushes, worths = np.empty(len(observations)), np.empty((len(observations), 3))
    ahead = CommonForesight(envs)._ahead
    episode = float(ahead.samples), ahead.energy
    burster(View(difference()))(envs.records, observations, *episode, terms, drawn(), pushes, worths)
    return pushes, worths


def reference(belief, seen, samples, energy, terms):
    """The first inputs and worths of all ways of one belief about Eq. (2), from its matrices."""
    L, theta = terms.limit, belief.coefficients_mean
    z0, P0 = belief.state_mean, belief.record[covariance_places(belief.model)]
    q, r = belief.noises[1] / belief.noises[0], belief.noises[3] / belief.noises[2]
    T, E = round(float(seen[20]) * samples), float(seen[21]) * energy
    between = lambda part, low, high: low * (high / low) ** part  # noqa: E731

    def after(z, u):
        return theta[0] * z[0] + theta[1] * z[0] ** 3 + theta[2] * z[1] + theta[3] * u

    def moved(z):
        return z[0] - z[1] + after(z, 0.0) - z[0]

    z, peak = z0, 0.0
    for _ in range(9 * terms.pace):
        peak, z = max(peak, abs(moved(z))), np.array([after(z, 0.0), z[0]])

    def way(part):
        hold, drive = between(part[0], 0.1, 1.5) * np.sqrt(E / T), between(part[2], 0.02, 0.8) / terms.pace
        rise, keep, wait = drive * between(part[4], 0.02, 1.0), 0.7 * part[3] * E, 0.9 * part[1] * T
        z, P, cost, left, phase, top, first, margin = z0, P0, 0.0, E, 0, peak, 0.0, 0.0
        gain, variance = np.zeros(6), 0.0
        for t in range(T):
            if phase == 0 and t >= wait:
                phase = 1
            if phase == 1 and left <= keep:
                phase = 2
            along = moved(z) / theta[3]
            top = max(abs(moved(z)), top * 0.9 ** (1 / terms.pace))
            even = hold if phase < 2 else np.sqrt(left / (T - t))
            if top > 0.01 * L:
                even *= 1.3 * abs(moved(z)) / top
            proportional = abs(along) * (drive if phase else rise)
            push = [max(even, proportional), proportional if top > 0.01 * L else max(even, proportional), even][phase]
            u = min(push, terms.amplitude) * (1.0 if along >= 0 else -1.0)
            then = after(z, u)
            ahead = then + (terms.pace - 1) * (then - z[0])
            u = -u if abs(ahead) > L - margin else u
            u = u if u**2 <= left else 0.0
            left -= u**2
            first = u if t == 0 else first
            S = np.eye(6)
            S[0] = [theta[0] + 3 * theta[1] * z[0] ** 2, theta[2], z[0], z[0] ** 3, z[1], u]
            S[1] = [1, 0, 0, 0, 0, 0]
            z, P = np.array([after(z, u), z[0]]), S @ P @ S.T
            P[0, 0] += q
            surprise, variance = (S @ gain)[0] ** 2 * variance, P[0, 0] + r
            gain = P[:, 0] / variance
            P = P - np.outer(gain, P[0])
            margin = min(terms.margin * np.sqrt(variance + max(surprise, terms.shaken * q)), 0.5 * L)
            cost += 1e4 / L * max(0.0, abs(z[0]) + margin - L)
        return first, 0.5 * np.linalg.slogdet(np.linalg.inv(P[2:, 2:]))[1] - cost

    blocks = drawn()
    tried = np.clip(blocks[0], 0, 1)
    firsts, scores = np.array([way(part) for part in tried]).T
    more = np.clip(tried[scores.argmax()] + blocks[1], 0, 1)
    others = np.array([way(part) for part in more]).T
    return np.concatenate([firsts, others[0]]), np.concatenate([scores, others[1]])


@pytest.mark.parametrize(("pace", "samples"), [(1, 0), (1, 12), (2, 12)])
def test_bursts_are_those_of_the_matrices(pace, samples):
    envs, seen = begun(samples, {"max_rms": 0.08})
    foresight = CommonForesight(envs)
    terms = foresight._terms._replace(pace=pace, shaken=3.0)
    pushes, worths = found(envs, seen, terms)
    terms = terms._replace(margin=terms.margin[samples])
    for i in range(len(seen)):
        firsts, scores = reference(envs.belief(i), seen[i], foresight._ahead.samples, foresight._ahead.energy, terms)
        best = scores.argmax()
        assert worths[i, 1] - scores[best] == pytest.approx(0.0, abs=1e-6 * max(1.0, abs(scores[best])))
        assert pushes[i] == pytest.approx(firsts[best], rel=1e-4)
        parts = firsts / firsts[best]
        for column, others in ((0, scores[parts >= 1.25]), (2, scores[parts <= 0.75])):
            expected = others.max() if len(others) else -1e300
            assert worths[i, column] == pytest.approx(expected, rel=1e-5, abs=1e-5)


def test_a_burst_is_no_harder_than_what_is_left():
    envs, seen = begun(20)
    seen[:, 21] = [0.0, 1e-6, 1e-4, 0.01, 0.5, 1.0]  # of the energy
    foresight = CommonForesight(envs)
    pushes, _ = found(envs, seen, foresight._terms)
    assert (pushes**2 <= seen[:, 21] * foresight._ahead.energy).all()
    assert np.isfinite(pushes).all()


def test_the_rule_saves_energy_for_a_burst():
    """Most of the energy goes into a fifth of the episode, and it is worth far more than what spends it evenly."""
    envs = make(TRACK, 32, TESTED)
    gains = {}
    for name in ("lookahead", "prbs"):
        policy = make_policy(name, envs, seed=0)
        observations, _ = envs.reset(seed=0)
        gained, spent, state = np.zeros(32), [], None
        for _ in range(envs.horizon):
            before = observations[:, 21]
            observations, rewards, terminated, _, _ = envs.step(
                policy.predict(observations, state, deterministic=True)[0]
            )
            assert not terminated.any() or name == "prbs"
            gained += rewards
            spent.append(before - observations[:, 21])
        gains[name] = gained.mean()
        if name == "lookahead":
            parts = np.sort(np.array(spent)[:-1], axis=0)[-51:].sum(axis=0)
            assert np.median(parts) > 0.6
    assert gains["lookahead"] > gains["prbs"] + 5.0


def test_choices_push_harder_than_the_burst_or_less():
    safe = np.ones((4, 3), dtype=bool)
    bursts = np.array([0.2, -0.3, 0.8, 0.1])
    view = Sight(
        np.zeros((4, 1), np.float32), safe, np.array([1.0, -1.0, 1.0, 1.0]), np.ones((4, 2)), np.full(4, 0.9), bursts
    )
    np.testing.assert_allclose(view.act(np.zeros(4))[:, 0], bursts, rtol=1e-6)
    np.testing.assert_allclose(view.act(np.full(4, -1.0))[:, 0], 0.0)
    np.testing.assert_allclose(view.act(np.full(4, 0.5))[:, 0], [0.3, -0.45, 0.9, 0.15], rtol=1e-6)
    safe[0] = False, True, True  # none instead of up
    safe[1] = (
        True,
        False,
        False,
    )  # it moves down, so that the push is up of what is upright: in full, none is not enough
    safe[3] = False, False, True  # the other way
    np.testing.assert_allclose(view.act(np.zeros(4))[:, 0], [0.0, -0.9, 0.8, -0.9], rtol=1e-6)


def test_features_tell_what_harder_and_softer_ways_bring():
    envs, seen = begun(12)
    foresight = CommonForesight(envs, own=True)
    view = foresight.look(seen)
    pushes, worths = found(envs, seen, foresight._terms)
    np.testing.assert_array_equal(view.bursts, pushes / envs.max_input)
    assert (view.pushes >= np.abs(view.bursts)).all()
    harder = view.features[:, FEATURES.index("best_up_whole")]
    expected = np.clip(np.arcsinh(20 * (worths[:, 0] - worths[:, 2])), -10, 10)
    np.testing.assert_allclose(harder, expected, rtol=1e-6)
    assert (view.features[:, FEATURES.index("best_none_whole")] >= 1.0).all()
    plain = make("duffing_env/Amplitude-v0", 1)
    assert CommonForesight(plain).look(plain.reset(seed=0)[0]).bursts is None
