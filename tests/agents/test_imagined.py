"""What all beliefs have in common: against plain NumPy, turned over, alone and in a batch, finite, and shielded."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.stats import t as student_t

from agents.evaluation.batch import make
from agents.planner.candidates import uniform
from agents.planner.mapped import enough_for
from agents.planner.motion import View
from agents.policies import make_policy
from agents.policies.foresight import CommonForesight
from agents.policies.imagined import BOUND, FEATURES, imaginer
from agents.policies.lookahead import rule
from agents.policies.ways import CHANGES, ROUNDS, WORDS
from agents.studies.family import play, unseen
from agents.training import PPOSettings, TrainConfig, train
from agents.training.family import draw_member
from estimator.belief import covariance_places
from estimator.models.difference import difference


def observations_of(envs, samples, seed=0):
    """Observations on the way under random pushes."""
    rng = np.random.default_rng(seed)
    observations, _ = envs.reset(seed=seed)
    for _ in range(samples):
        actions = rng.choice([-0.6, 0.0, 0.6], (envs.num_envs, 1)).astype(np.float32)
        observations, *_ = envs.step(actions)
    return observations


#: Of the first moves.
DIRECTIONS = (1.0, 0.0, -1.0)


def beside(envs, records, seen):
    """The same environments with other beliefs, whatever they showed."""
    return SimpleNamespace(experiment=envs.experiment, records=records, shown=seen)


def reference(belief, seen, ahead, terms, least=0.0):
    """The features of one belief about Eq. (2), from its matrices, way by way."""
    L = terms.limit
    P, theta, z = belief.record[covariance_places(belief.model)], belief.coefficients_mean, belief.state_mean
    q, r = belief.noises[1] / belief.noises[0], belief.noises[3] / belief.noises[2]
    last_u, time_left = seen[18], seen[20]
    thrift = min(1.0, np.sqrt(seen[21] * ahead.energy / max(1.0, time_left * ahead.samples)) / ahead.push)
    A = max(least, ahead.push * min(1.0, 2.0 * thrift))
    share = 0.5 * (time_left + seen[21]) if ahead.energy < np.inf else time_left
    told_so_far = np.linalg.inv(P[2:, 2:]) - ahead.known
    rate = (32 * ahead.rate + told_so_far) / (32 + (1 - time_left) * ahead.samples)
    left, to_come = time_left * ahead.samples, share * ahead.samples

    def sample(z, P, u, gain, variance):
        moved = np.array([theta[0] * z[0] + theta[1] * z[0] ** 3 + theta[2] * z[1] + theta[3] * u, z[0]])
        S = np.eye(6)
        S[0] = [theta[0] + 3 * theta[1] * z[0] ** 2, theta[2], z[0], z[0] ** 3, z[1], u]
        S[1] = [1, 0, 0, 0, 0, 0]
        P = S @ P @ S.T
        P[0, 0] += q
        surprise = (S @ gain)[0] ** 2 * variance  # what the output before may tell
        variance = P[0, 0] + r
        gain = P[:, 0] / variance
        wide = terms.margin * np.sqrt(variance + max(surprise, terms.shaken * q))
        spared = terms.reach * (A + u if moved[0] > 0 else A - u)  # what braking harder than planned makes up for
        margin = min(max(terms.margin * np.sqrt(variance), wide - spared), 0.5 * L)
        return moved, P - np.outer(gain, P[0]), gain, variance, margin

    spread = sample(z, P, last_u * terms.amplitude, np.zeros(6), 0.0)[3]
    wanted = 3.0 * spread / (spread - r) / terms.pace  # samples for each output that tells of a state
    moves = min(int(max(wanted, ahead.moves)), ahead.most)
    pace = min(terms.pace, max(1, int(left / moves + 0.5)))
    moves = max(4, min(moves, int(np.ceil(round(left) / pace))))
    faded = 0.6 * terms.faded + 1.1 * 4 * (r / q) ** 0.25 / pace if left > max(moves, 32) * pace else np.inf
    weights = -np.diff(np.append(np.exp(-((np.arange(moves) / faded) ** 2)), 0.0))
    names = ("pump", "brake", "rest")

    def worth(P, left):
        return 0.5 * np.linalg.slogdet(np.linalg.inv(P[2:, 2:]) + left * rate)[1]

    def follow(push):
        """Worths, peak, what was seen, and inputs of a way whose push at move t is push(t, x, margin)."""
        x, C, cost, peak, told, seen_at, inputs, margin = z, P, 0.0, 0.0, [], [], [], 0.0
        gain, variance = np.zeros(6), 0.0
        for t in range(moves):
            u = push(t, x, margin)
            inputs.append(u)
            for s in range(t * pace, (t + 1) * pace):
                x, C, gain, variance, margin = sample(x, C, u, gain, variance)
                reach = abs(x[0]) + margin
                cost += 1e4 / L * max(0.0, reach - L)
                peak = max(peak, reach) if s < min(left, 8 * terms.pace) else peak
            seen_at.append(x[0])
            told.append(worth(C, max(0.0, to_come - (t + 1) * pace)) - cost)
        return [told[(moves + 1) // 2 - 1], np.dot(weights, told)], peak, seen_at, inputs

    def simple(first, name):
        def push(t, x, margin):
            if t == 0:
                return DIRECTIONS[first] * A
            along = A if x[0] - x[1] >= 0 else -A
            then = theta[0] * x[0] + theta[1] * x[0] ** 3 + theta[2] * x[1] + theta[3] * along
            pump = -along if abs(then + (pace - 1) * (then - x[0])) > L - margin else along
            return {"pump": pump, "brake": -along, "rest": 0.0}[name]

        return follow(push)

    stretches = -(-moves // 12)
    followed_most = 32 * stretches * max(1, min(3, -(-moves // ahead.moves)))

    def mapped(first, sign):
        """The inputs of the best way through the map of the state."""
        words, cells = np.array(WORDS), 35
        offsets = uniform(words), uniform(words)

        def cell(x):
            where = [(sign * x[i] / terms.scales[i] + 1) / 2 * (cells - 1) + offsets[i] for i in range(2)]
            return tuple(int(np.clip(w, 0, cells - 1)) for w in where)

        # Of a way: its state, joint covariance, gain and variance of the last output, cost, and inputs.
        followed = [(z, P, np.zeros(6), 0.0, 0.0, [])]
        for t in range(moves):
            sizes = (1.0, -1.0, 0.0, 0.5, -0.5) if t < 7 else (1.0, -1.0)
            if t == 0:
                sizes = DIRECTIONS[first] * np.array([1.0, 0.75, 0.5, 0.25] if first != 1 and pace == 1 else [1.0])
            entered = {}
            for x, C, gain, variance, cost, inputs in followed:
                for size in sizes:
                    to, D, told, spread, price = x, C, gain, variance, cost
                    for _ in range(pace):
                        to, D, told, spread, margin = sample(to, D, size * A, told, spread)
                        price += 1e4 / L * max(0.0, abs(to[0]) + margin - L)
                    score = worth(D, max(0, int(to_come + 0.5) - (t + 1) * pace)) - price
                    if score > entered.get(cell(to), (-np.inf,))[0]:
                        entered[cell(to)] = score, (to, D, told, spread, price, [*inputs, size * A])
            enough = enough_for(np.array([score for score, _ in entered.values()]), followed_most)
            kept = [found for found in entered.values() if found[0] >= enough][:followed_most]
            followed = [way for _, way in kept]
        return followed[int(np.argmax([score for score, _ in kept]))][-1]

    def refined(first, sign):
        """The best way of a first move after its changes."""
        ways = [simples[first, name][3] for name in names]
        has_bursts = ahead.energy < np.inf
        start = ways[0] if has_bursts else mapped(first, sign)
        best = None
        for r in range(1 if first == 1 else 2 if has_bursts else ROUNDS * stretches):
            tries = []
            for j in range(32):
                plan = np.array(ways[j - 1] if r == 0 and 0 < j <= 3 else start if r == 0 else best[3])
                h = int(CHANGES.where[r, j] * moves)
                turned = slice(max(1, h), h + CHANGES.turned[r, j])
                plan[turned] = np.where(plan[turned] != 0, -plan[turned], sign * A)
                size = len(plan[h : h + 2])
                plan[h : h + 2] = np.clip(plan[h : h + 2] + sign * A * CHANGES.moved[r, j, :size], -A, A)
                plan[0] = DIRECTIONS[first] * max(0.02 * A if pace == 1 else A, DIRECTIONS[first] * plan[0])
                tries.append(follow(lambda t, x, margin, plan=plan: plan[t]))
            best = max([best, *tries] if best else tries, key=lambda found: found[0][1])
        return best

    simples = {(first, name): simple(first, name) for first in range(3) for name in names}
    free = np.array([[simples[first, "rest"][2][t] for first in range(3)] for t in range(3)])
    sign = 1.0 if free[0, 1] >= 0 else -1.0
    up, down = (0, 2) if sign > 0 else (2, 0)
    best = [refined(first, sign) for first in range(3)]
    groups = [best, *([simples[first, name] for first in range(3)] for name in ("brake", "rest"))]
    peaks = np.array([[found[1] for found in group] for group in groups])
    told = [seen[4:8].mean(), seen[4:8].max(), sign * last_u, sign * seen[19], *seen[14:16], time_left, thrift]
    for group in groups:
        for h in range(2):
            rise, calm, fall = (group[f][0][h] for f in (up, 1, down))
            told += [np.arcsinh(20 * (rise - fall)), np.arcsinh(20 * (calm - max(rise, fall)))]
    told += [peaks[group, first] / L for group in range(3) for first in (up, 1, down)]
    told += [*(sign * free[:, 1] / L), *((free[:2, 0] - free[:2, 2]) / L)]
    now = worth(P, to_come)
    told += [np.arcsinh(20 * (max(found[0][1] for found in best) - now)), now - worth(P, 0.0)]
    lowest = peaks.min(axis=0)
    allowed, shares = lowest <= max(L, peaks[0].min()), np.ones(3)
    for push in (0, 2):
        if best[push][1] <= L and pace == 1:
            allowed[push], shares[push] = True, abs(best[push][3][0]) / A if A > 0 else 1.0
    turned = slice(None, None, int(sign))
    return np.clip(told, -BOUND, BOUND), allowed[turned], sign, shares[turned][::2]


@pytest.mark.parametrize(
    ("track", "pace", "least", "options"),
    [
        ("Amplitude", 1, 0.0, {}),
        ("Amplitude", 2, 0.0, {}),
        ("Amplitude", 1, 0.0, {"horizon": 46}),  # the end is near
        ("Amplitude", 1, 0.0, {"horizon": 43}),  # nearer than the shortest way
        ("Amplitude", 3, 0.0, {"horizon": 58}),
        ("Amplitude", 1, 0.0, {"process_noise": 5e-5, "measurement_noise": 5e-3}),  # many outputs tell of a state
        ("Power", 1, 0.0, {}),
        ("Power", 1, 0.1, {}),
    ],
)
def test_features_are_those_of_the_matrices(track, pace, least, options):
    envs = make(f"duffing_env/{track}-v0", 12, options)
    seen = observations_of(envs, 40)
    foresight = CommonForesight(envs)
    terms = foresight._terms._replace(pace=pace, shaken=3.0)
    features, safe = np.empty((12, len(FEATURES)), np.float32), np.empty((12, 3), np.bool_)
    signs, shares, pushes = np.empty(12), np.empty((12, 2)), np.full(12, least)
    ahead = foresight._ahead
    imaginer(View(difference()))(envs.records, seen, ahead, terms, features, safe, signs, shares, pushes)
    assert {*signs} == {-1.0, 1.0}
    assert (shares.min() < 1.0) == ((track == "Amplitude" and pace == 1) or least > 0.0)
    terms = terms._replace(margin=terms.margin[40])
    # Those of either sign, of a push that is not allowed, and of a smaller one, say most.
    rows = {np.argmin(signs), np.argmax(signs), np.argmax((~safe).any(axis=1)), np.argmin(shares.min(axis=1))}
    for i in rows:
        told, allowed, sign, share = reference(envs.belief(i), seen[i], ahead, terms, least)
        np.testing.assert_allclose(features[i], told, rtol=2e-3, atol=2e-3)
        np.testing.assert_array_equal(safe[i], allowed)
        np.testing.assert_allclose(shares[i], share, rtol=1e-6)
        assert signs[i] == sign


def test_a_belief_looks_the_same_alone_and_any_is_finite():
    envs = make("duffing_env/Amplitude-v0", 12)
    foresight, rng = CommonForesight(envs), np.random.default_rng(1)
    seen = observations_of(envs, 40)
    records = envs.records * rng.choice([-1e3, 0.0, 1e-3, 1.0, 1e6], envs.records.shape)
    view = CommonForesight(beside(envs, records, seen)).look(seen)
    assert np.isfinite(view.features).all()
    assert (np.abs(view.features) <= BOUND).all()
    assert view.safe.any(axis=1).all()
    alone = CommonForesight(beside(envs, envs.records[7:8], seen[7:8])).look(seen[7:8])
    np.testing.assert_array_equal(alone.features[0], foresight.look(seen).features[7])


def test_turning_the_task_over_turns_the_action_over():
    envs = make("duffing_env/Amplitude-v0", 12)
    seen, records = observations_of(envs, 40), envs.records
    turned = seen.copy()
    turned[:, 16:20] *= -1
    states = np.arange(6) < 2
    records[:, :2] *= -1
    crossed = covariance_places(envs.experiment.model)[states[:, None] & ~states]
    records[:, crossed] *= -1
    foresight, reverse = CommonForesight(envs), CommonForesight(beside(envs, records, turned))
    one, other = foresight.look(seen), reverse.look(turned)
    np.testing.assert_allclose(one.features, other.features, atol=1e-5)
    choices = np.linspace(-1, 1, 12)
    np.testing.assert_allclose(one.act(choices), -other.act(choices), atol=1e-6)


def test_it_refuses_what_it_cannot_look_at():
    with pytest.raises(ValueError, match="env must be one of duffing_env"):
        CommonForesight(SimpleNamespace())
    with pytest.raises(ValueError, match="hold must be 1"):
        CommonForesight(make("duffing_env/Amplitude-v0", 1, {"hold": 2}))
    envs = make("duffing_env/Amplitude-v0", 2)
    with pytest.raises(ValueError, match=r"showed last, but has shape \(1, 22\) in place of \(2, 22\)"):
        CommonForesight(envs).look(observations_of(envs, 1)[:1])


def test_members_are_drawn_within_their_ranges_and_make_environments():
    kinds = set()
    for i in range(60):
        member = draw_member(np.random.default_rng(i))
        kinds.add(member.kind)
        guess = member.options["rig"]["guess"]
        assert 6 <= member.period <= 60
        assert 0.002 <= member.damping <= 0.3
        assert 0.02 <= member.drive <= 1
        a, b = (np.mean(guess[name]) for name in "ab")
        # The input limit of 1 is the drive's part of the static force at X = 1.
        assert abs(a + b) * member.drive == pytest.approx(1.0, rel=1e-9)
        assert 64 <= member.options["horizon"] <= 1024
    assert kinds == {"hardening", "softening", "double-well"}
    assert make("duffing_env/Rig-v0", 1, member.options).horizon == member.options["horizon"]


def test_lookahead_needs_an_environment_whose_posterior_it_sees():
    with pytest.raises(ValueError, match="env must be one of duffing_env"):
        make_policy("lookahead")
    with pytest.raises(ValueError, match="'posterior' for lookahead, but shows 'history'"):
        make_policy("lookahead", make("duffing_env/Amplitude-v0", 2, {"observation": "history"}))
    policy = make_policy("lookahead", make("duffing_env/Amplitude-v0", 2))
    with pytest.raises(ValueError, match="observation must have 22 entries"):
        policy.predict(np.zeros((2, 21), dtype=np.float32))
    with pytest.raises(ValueError, match="observation must be finite"):
        policy.predict(np.full((2, 22), np.nan, dtype=np.float32))


def test_lookahead_is_ahead_of_a_signal_on_unseen_members():
    members = [member for member in unseen(24) if member.options["horizon"] < 200]
    ours, signal = ([play(member, name, i)[0] for i, member in enumerate(members)] for name in ("lookahead", "prbs"))
    assert np.median(np.subtract(ours, signal)) > 0.5


def test_it_plays_a_track_that_it_was_not_trained_on():
    gains = {}
    for name in ("lookahead", "prbs"):
        envs = make("duffing_env/Amplitude-v0", 16)
        policy = make_policy(name, envs)
        observations, _ = envs.reset(seed=3)
        state, gains[name], running = None, 0.0, np.ones(16, dtype=np.bool_)
        for _ in range(envs.horizon):
            actions, state = policy.predict(observations, state, deterministic=True)
            observations, _, terminated, truncated, infos = envs.step(actions)
            gains[name] += np.where(running, infos["information_gain"], 0.0).mean()
            running &= ~(terminated | truncated)
    assert gains["lookahead"] > gains["prbs"] + 1.0


def test_beside_the_observation_it_is_turned_upright():
    envs = make("duffing_env/Amplitude-v0", 12)
    seen = observations_of(envs, 40)
    common, own = CommonForesight(envs).look(seen), CommonForesight(envs, own=True).look(seen)
    np.testing.assert_array_equal(own.features[:, : len(FEATURES)], common.features)
    upright = own.features[:, len(FEATURES) :].copy()
    upright[:, 16:20] *= own.signs[:, None]
    np.testing.assert_allclose(upright, seen, atol=1e-6)
    assert {*own.signs} == {-1.0, 1.0}


def test_on_a_rig_it_keeps_further_from_the_limit():
    # Of 256 outputs at the margin one is beyond the limit in one episode of fifty, on a rig in one of a thousand.
    freedom = 4 + (2 + np.arange(256) / 16) ** 2
    for track in ("Amplitude-v0", "Amplitude-v1"):
        simulated = CommonForesight(make(f"duffing_env/{track}", 1))._terms
        np.testing.assert_allclose(256 * student_t(freedom).sf(simulated.margin), 0.02, rtol=1e-6)
        assert simulated.shaken == 0.0
    rig = make("duffing_env/Rig-v0", 1, {"rig": draw_member(np.random.default_rng(1)).options["rig"], "horizon": 256})
    terms = CommonForesight(rig)._terms
    np.testing.assert_allclose(256 * student_t(freedom).sf(terms.margin), 0.001, rtol=1e-6)
    assert terms.shaken > 0.0


@pytest.mark.parametrize(("logit", "least", "most"), [(1.0, 0.7, 0.95), (3.0, 0.98, 1.0)])
def test_a_policy_begins_at_the_rule_and_plays_its_own_model_alone(tmp_path, logit, least, most):
    settings = PPOSettings(foresight=True, levels=3, num_envs=512, n_steps=2, batch_size=512)
    settings = replace(settings, learning_rate=1e-9, rule_logit=logit)
    run = train(
        TrainConfig(env="duffing_env/Amplitude-v0", steps=1024, output=tmp_path / "r", hyperparameters=settings)
    )
    envs = make("duffing_env/Amplitude-v0", 256)
    policy = make_policy(str(run.folder), envs)
    seen = observations_of(envs, 30)
    view = CommonForesight(envs).look(seen)
    expected = view.act(rule(view.features))
    # Of a few beliefs two ways are worth about the same.
    by = [FEATURES.index(f"best_{way}_whole") for way in ("up", "none")]
    clear = (np.abs(view.features[:, by]) > 0.1).all(axis=1)
    assert clear.mean() > 0.8
    agrees = np.isclose(policy.predict(seen, deterministic=True)[0], expected)
    assert agrees[clear].all()
    explored = [np.isclose(policy.predict(seen, deterministic=False)[0], expected)[clear].mean() for _ in range(4)]
    assert least < np.mean(explored) <= most
    with pytest.raises(ValueError, match="another model than the policy was trained on"):
        make_policy(str(run.folder), make("duffing_env/Pendulum-v0", 1))
