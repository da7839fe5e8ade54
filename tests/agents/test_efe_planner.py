"""The planner, sample by sample and in blocks: its limits, its batches and its goals.

All that compiles the search of a model is in this file: one process then compiles most of it only once.
"""

import copy
import itertools
from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import pytest
from scipy.stats import t
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv
from tables import table

import duffing_env
from agents.planning.model_probe import ModelView
from agents.planning.open_loop import chance_constrained_block
from agents.planning.plan_objective import PlanObjective
from agents.planning.receding_horizon import PlanArrays, compile_receding_horizon
from agents.planning.time_scales import probe_time_scales, recoverable_step
from agents.policies import block_planner, make_policy
from agents.policies.block_planner import BlockPlanner
from agents.policies.efe_planner import EfePlanner
from duffing_env.experiment_config import SimulatedExperiment
from estimator import Channel, Rig
from estimator.belief import Belief, covariance_indices
from estimator.models.difference_equation import difference
from estimator.models.duffing import duffing
from estimator.models.model import Model
from estimator.models.wiener_hammerstein import WIENER_HAMMERSTEIN
from estimator.priors import silverbox_prior
from estimator.rigs.silverbox_constants import SILVERBOX_SAMPLING_STEP


def make(track, n, **options):
    track = track if "-v" in track else f"{track}-v0"
    return gym.make_vec(f"duffing_env/{track}", num_envs=n, vectorization_mode="vector_entry_point", **options)


def roll_out(track, n, seed=0, steps=None, options=None, name="efe", **planner):
    """Inputs and outputs (steps, n) of a policy, NaN after an episode's end, how many ended early, and gains (n,)."""
    envs = make(track, n, **(options or {}))
    policy = make_policy(name, envs, seed=seed, **planner)
    observations, _ = envs.reset(seed=0)
    place = list(duffing_env.storage.kernel_spec.observation_bounds(envs.experiment.model)).index
    last = place(f"last_{next(iter(envs.experiment.model.outputs))}")
    state, start, running = None, np.ones(n, dtype=bool), np.ones(n, dtype=bool)
    inputs, outputs, early, gains = [], [], 0, np.zeros(n)
    for _ in range(steps or envs.horizon):
        actions, state = policy.predict(observations, state, start)
        observations, rewards, terminated, truncated, _ = envs.step(actions)
        start = terminated | truncated
        inputs.append(np.where(running, envs.max_input * actions[:, 0], np.nan))
        outputs.append(np.where(running, envs.experiment.max_output * observations[:, last], np.nan))
        gains += running * rewards
        early += int((running & terminated).sum())
        running &= ~start
    return np.array(inputs), np.array(outputs), early, gains


BELIEVING = pytest.mark.parametrize("name", ["efe", "shield"])
NOT_SHOWN = "observation must be what the environment of this policy showed last, but "


def played(policy, observations, step, steps=3):
    """Observations of some steps under a policy."""
    state = None
    for _ in range(steps):
        action, state = policy.predict(observations, state)
        observations = step(action)
    return observations


@BELIEVING
@pytest.mark.parametrize("mode", ["NextStep", "SameStep", "Disabled"])
def test_it_plays_its_own_environments_through_their_ends(name, mode):
    envs = make("Short", 3, horizon=5, autoreset_mode=mode)
    policy, (observations, _) = make_policy(name, envs), envs.reset(seed=0)
    for k in range(14):
        actions, _ = policy.predict(observations.astype(np.float64 if k % 2 else np.float32))
        observations, _, terminated, truncated, _ = envs.step(actions)
        if mode == "Disabled" and (terminated | truncated).any():
            policy.predict(observations)
            observations, _ = envs.reset(options={"reset_mask": np.array([k > 6, True, True])})
            if k < 6:
                observations, _ = envs.reset(options={"reset_mask": np.array([True, False, False])})


@BELIEVING
@pytest.mark.parametrize("wrap", [
    lambda env: env, gym.wrappers.RecordEpisodeStatistics, lambda env: gym.wrappers.TimeLimit(env, 40),
    gym.wrappers.FlattenObservation,
])  # fmt: skip
def test_wrappers_that_leave_observations_alone_are_played(name, wrap):
    env = wrap(gym.make("duffing_env/Short-v0"))
    policy = make_policy(name, env)
    played(policy, env.reset(seed=0)[0], lambda action: env.step(action)[0])
    # The pair of them goes on from a copy.
    copied, its = copy.deepcopy((env, policy))
    one, other = (
        played(p, e.unwrapped.last_observations[0], lambda a, e=e: e.step(a)[0])
        for e, p in ((env, policy), (copied, its))
    )
    np.testing.assert_array_equal(one, other)
    # A batch of one, as Stable-Baselines3 has it.
    envs = DummyVecEnv([lambda: Monitor(env)])
    for its in (policy, make_policy(name, envs)):
        played(its, envs.reset(), lambda actions: envs.step(actions)[0], steps=50)


@pytest.mark.parametrize("wrap", [
    lambda env: gym.wrappers.TransformObservation(env, lambda seen: 0.0 * seen, env.observation_space),
    lambda env: gym.wrappers.TransformObservation(env, lambda seen: seen + np.float32(1e-6), env.observation_space),
    lambda env: gym.wrappers.DelayObservation(env, 3), gym.wrappers.NormalizeObservation,
    lambda env: gym.wrappers.RescaleObservation(env, np.float32(-1), np.float32(1)),
    gym.wrappers.TimeAwareObservation,
])  # fmt: skip
def test_wrappers_that_change_observations_are_refused(wrap):
    env = wrap(gym.make("duffing_env/Short-v0"))
    policy = make_policy("efe", env)
    with pytest.raises(ValueError, match=NOT_SHOWN):
        played(policy, env.reset(seed=0)[0], lambda action: env.step(action)[0])


@pytest.mark.parametrize("rows", [3, 4])
def test_another_environment_than_its_own_is_refused(rows):
    envs, other = make("Short", 3), make("Short", rows)
    envs.reset(seed=0)
    policy, (observations, _) = make_policy("efe", envs), other.reset(seed=0)
    message = f"{NOT_SHOWN}entry . of environment 0 is .* in place of 0; .* make it for the environment that is played"
    with pytest.raises(ValueError, match=message if rows == 3 else r"3 environments|has shape \(4, 22\) in place of"):
        played(policy, observations, lambda actions: other.step(actions)[0])
    left_behind, _ = envs.reset(seed=0)
    envs.step(np.ones((3, 1), np.float32))
    with pytest.raises(ValueError, match=NOT_SHOWN):
        policy.predict(left_behind)


def test_the_planner_needs_the_posterior_to_be_shown():
    with pytest.raises(ValueError, match=r"env must show the posterior, .* but its observation is 'history'"):
        make_policy("efe", make("Short", 2, observation="history", history=20))


@pytest.mark.parametrize("track", ["Amplitude", "Power"])
def test_rows_do_not_depend_on_the_batch(track):
    few, *_ = roll_out(track, 2, seed=3, steps=20)
    many, *_ = roll_out(track, 5, seed=3, steps=20)
    np.testing.assert_array_equal(few, many[:, :2])


def test_the_next_best_plan_is_another_one_and_is_followed_where_it_is_the_best():
    n, envs = 64, make("Amplitude", 64)
    planner = EfePlanner(envs)
    observations, _ = envs.reset(seed=0)
    state, start = None, np.ones(n, dtype=bool)
    for _ in range(30):
        actions, state = planner.predict(observations, state, start)
        observations, _, terminated, truncated, _ = envs.step(actions)
        start = terminated | truncated

    def gap(plans, others):
        return np.abs(plans - others)[:, 1:20].max(axis=1) / envs.max_input

    there = state.runner_ups.any(axis=1)
    assert there.mean() > 0.9
    assert (np.abs(state.plans - state.runner_ups)[there, :20].max(axis=1) > 0.3 * envs.max_input).all()

    def followed(**changed):
        _, after = planner.predict(observations, state._replace(**changed), start)
        return (gap(after.plans, np.roll(state.plans, -1, axis=1)) < 0.3).mean()

    none = np.zeros_like(state.plans)
    anew = followed(plans=none, runner_ups=none)
    assert followed(plans=none, runner_ups=state.plans) > anew + 0.15
    assert followed(plans=state.runner_ups, runner_ups=state.plans) > anew + 0.15


def test_the_seed_is_that_of_the_search():
    first, *_ = roll_out("Amplitude", 2, seed=3, steps=20)
    assert not np.array_equal(first, roll_out("Amplitude", 2, seed=4, steps=20)[0])


def test_no_limit_is_violated_and_the_inputs_are_at_theirs():
    inputs, outputs, early, _ = roll_out("Short", 64)
    assert early == 0
    assert np.abs(outputs).max() > 0.55
    assert np.abs(inputs).max() <= np.float32(0.15)
    assert np.mean(np.abs(inputs) > 0.149) > 0.7


def test_a_slew_limit_cuts_nothing_that_was_planned():
    inputs, outputs, early, _ = roll_out("Short", 4, options={"max_slew": 0.06})
    changes = np.abs(np.diff(inputs, axis=0, prepend=0.0))
    assert early == 0
    assert changes.max() <= 0.06 * (1 + 1e-6)
    assert np.mean(changes > 0.059) > 0.3
    assert np.abs(outputs).max() > 0.5


def test_the_budget_is_spent_and_not_exceeded():
    inputs, _, early, _ = roll_out("Power", 4)
    assert early == 0
    energy = (inputs**2).sum(axis=0) / (256 * 0.0222**2)
    assert np.all(energy <= 1 + 1e-4)
    assert np.all(energy > 0.98)


def test_a_longer_horizon_gains_more_than_one_step_and_a_goal_keeps_still():
    *_, near = roll_out("Short", 4, options={"max_output": 0.3}, horizon=1)
    far, *_, gains = roll_out("Short", 4, options={"max_output": 0.3})
    assert gains.mean() > near.mean() + 0.5
    _, still, *_ = roll_out("Short", 4, goal_std=1e-3)
    _, loud, *_ = roll_out("Short", 4)
    assert np.abs(still).max() < 0.2 * np.abs(loud).max()
    cheap, *_ = roll_out("Short", 4, input_cost=1e6)
    assert np.nanmean(cheap**2) < 0.1 * np.nanmean(far**2)


def test_single_environments_are_planned_for_as_rows_are():
    batch, *_ = roll_out("Amplitude", 1, steps=10)
    env = gym.make("duffing_env/Amplitude-v0")
    policy, state = make_policy("efe", env), None
    observation, _ = env.reset(seed=duffing_env.batch.spawn_seeds(0, 1)[0])
    for expected in batch[:, 0]:
        action, state = policy.predict(observation, state)
        assert action.shape == (1,)
        assert 0.15 * action[0] == pytest.approx(expected)
        observation, *_ = env.step(action)


@table(
    ("options", "words"),
    [
        ({"horizon": 0}, "horizon must be a whole number"),
        ({"rounds": 1.5}, "rounds must be a whole number"),
        ({"risk": 0.0}, "risk must be a number from 1e-12"),
        ({"input_cost": float("inf")}, "input_cost must be a number from 0"),
        ({"goal_std": 0.0}, "goal_std must be a number from 1e-12"),
        ({"goal": 0.2}, "goal_std must be given with a goal, but is None for goal=0.2"),
        ({"goal": 0.7, "goal_std": 0.1}, "goal must be a number from -0.6 to 0.6, but is 0.7; a goal lies within"),
        ({"horizn": 3}, "horizn=3 is no option of policy 'efe'"),
    ],
)
def test_errors_name_the_argument(options, words):
    with pytest.raises(ValueError, match=words):
        make_policy("efe", gym.make("duffing_env/Amplitude-v0"), **options)


def test_a_planner_needs_an_environment_of_its_own():
    with pytest.raises(ValueError, match="env must be an environment of duffing_env"):
        make_policy("efe")
    with pytest.raises(ValueError, match="env must be an environment of duffing_env"):
        EfePlanner(SimpleNamespace(max_input=0.1))
    policy = make_policy("efe", gym.make("duffing_env/Amplitude-v0"))
    with pytest.raises(ValueError, match="of the 1 environments of this planner"):
        policy.predict(np.zeros((3, 22)))


def test_a_plan_of_the_whole_episode_has_neither_goal_nor_cost():
    env = gym.make("duffing_env/Power-v0")
    with pytest.raises(ValueError, match="pass a horizon"):
        make_policy("efe", env, input_cost=1.0)
    assert make_policy("efe", env, horizon=4, input_cost=1.0).horizon == 4


@pytest.mark.parametrize(
    ("track", "options", "systems", "most_early"),
    [
        ("Amplitude-v1", {"horizon": 48}, 8, 0),
        # Now and then an episode ends early: of strong process noise, or near where the difference equation blows up.
        pytest.param("Pendulum", {"horizon": 48, "max_input": 4.0, "max_output": 1.5}, 16, 1, marks=pytest.mark.slow),
        pytest.param("WienerHammerstein", {"horizon": 48}, 16, 0, marks=pytest.mark.slow),  # seconds of compilation
        ("Amplitude", {"horizon": 64, "max_output": 1.0}, 64, 6),
        pytest.param("Amplitude-v1", {"horizon": 48, "estimator": "nlarx"}, 16, 0, marks=pytest.mark.slow),
    ],
    ids=["Eq. (1)", "pendulum", "three states", "far limit", "Eq. (2) on Eq. (1)"],
)
def test_it_plays_any_model_within_its_limits_and_better_than_chance(track, options, systems, most_early):
    *_, early, gains = roll_out(track, systems, options=options)
    assert early <= most_early
    *_, chance = roll_out(track, systems, options=options, name="prbs")
    assert gains.mean() > chance.mean() + 0.5


def test_it_plays_a_plant_of_ones_own():
    class Plant:
        def reset(self):
            self.x = self.last = 0.0

        def step(self, u):
            self.x, self.last = 1.5 * self.x - 1.4 * self.x**3 - 0.95 * self.last + 0.4 * u, self.x
            return self.x

    gains = {}
    for name in ("efe", "prbs"):
        rig = Rig(SILVERBOX_SAMPLING_STEP, input=Channel("V", limit=1.0), output=Channel("V", range=1.0))
        own = {"max_input": 0.15, "max_output": 0.6, "prior": silverbox_prior(), "noise_hypotheses": 1}
        env = gym.make("duffing_env/Rig-v0", rig=rig, plant=Plant(), horizon=48, **own)
        policy, state, gains[name] = make_policy(name, env), None, 0.0
        observation, _ = env.reset(seed=0)
        terminated = truncated = False
        while not (terminated or truncated):
            action, state = policy.predict(observation, state)
            observation, reward, terminated, truncated, _ = env.step(action)
            gains[name] += reward
        assert not terminated
    assert gains["efe"] > gains["prbs"] + 0.5


def test_the_grid_scales_every_state_by_its_amplitude_at_the_limit():
    paper = SimulatedExperiment().prior_belief.coefficients_mean
    np.testing.assert_array_equal(probe_time_scales(ModelView(difference()), paper, 0.15, 0.6).scales, [0.6, 0.6])
    # A linear oscillator of 2π / 40 rad per sample: its velocity has that much of the displacement's amplitude.
    omega = 2 * np.pi / 40
    found = probe_time_scales(ModelView(duffing()), [omega**2, 0.0, 0.02, 0.01], 1.0, 0.6).scales
    np.testing.assert_allclose(found, [0.6, 0.6 * omega], rtol=0.15)
    # Also where no input comes near the limit.
    np.testing.assert_allclose(
        probe_time_scales(ModelView(duffing()), [omega**2, 0.0, 0.02, 0.01], 1.0, 1e3).scales[1], 1e3 * omega, rtol=0.15
    )
    seen = probe_time_scales(ModelView(WIENER_HAMMERSTEIN), [0.4, 0.1, 0.0, 0.5], 0.15, 0.6).scales
    assert seen[2] == 0.6
    assert np.all(seen[:2] > 0.1)
    decay = Model("decay", {"x": "V"}, {"rate": "1"}, noise=("1",), outputs={"y": "x"}, rates=("u - rate*x",))
    assert probe_time_scales(ModelView(decay), [0.3], 1.0, 2.0).scales == [2.0]


def test_plans_count_on_what_an_input_moves_within_its_sample():
    # From rest a held force moves a linear oscillator to its static deflection, less the cosine.
    omega, gain = 2 * np.pi / 9, 0.5
    held = probe_time_scales(ModelView(duffing()), [omega**2, 0.0, 0.0, gain], 0.15, 0.6)
    np.testing.assert_allclose(held.step_response, gain * (1 - np.cos(omega)) / omega**2, rtol=1e-3)
    assert probe_time_scales(ModelView(difference()), [1.5, -0.2, -0.9, 0.4], 0.15, 0.6).step_response == pytest.approx(
        0.4
    )

    free = SimpleNamespace(kernel_params=SimpleNamespace(max_slew=np.inf, budget=np.inf), model=duffing())
    assert recoverable_step(free, ModelView(duffing()), held) == 0.75 * held.step_response
    # An input that goes linearly from the last one acts in full a sample later; rigs keep the whole margin.
    slow = SimpleNamespace(kernel_params=SimpleNamespace(max_slew=0.1, budget=np.inf), model=duffing())
    weak = SimpleNamespace(kernel_params=SimpleNamespace(max_slew=np.inf, budget=1.0), model=duffing())
    rig = SimpleNamespace(kernel_params=free.kernel_params, model=duffing(), rig=Rig(SILVERBOX_SAMPLING_STEP))
    assert (
        recoverable_step(free, ModelView(duffing(), 1), held)
        == recoverable_step(free, ModelView(difference(), 0, 1), held)
        == 0.0
    )
    assert recoverable_step(free, ModelView(duffing()), held._replace(hold_samples=2)) == 0.0
    assert [recoverable_step(one, ModelView(duffing()), held) for one in (slow, weak, rig)] == [0.0, 0.0, 0.0]


def test_other_sensors_give_the_same_time_scales():
    omega = 2 * np.pi / 40
    means = [omega**2, 0.0, 0.02, 0.002]
    swings = [
        probe_time_scales(ModelView(duffing(sensor=sensor)), means, 1.0, 0.6 * omega**order)
        for order, sensor in enumerate(("displacement", "velocity", "acceleration"))
    ]
    assert {swing.hold_samples for swing in swings} == {round(40 / 9)}
    for order, swing in enumerate(swings):
        np.testing.assert_allclose(swing.scales, [0.6, 0.6 * omega], rtol=0.15)
        np.testing.assert_allclose(
            swing.accumulated_noise, swings[0].accumulated_noise * omega ** (2 * order), rtol=0.4
        )


@pytest.mark.slow  # seconds of compilation
def test_under_a_budget_plans_follow_the_differential_equation_too():
    options = {"horizon": 128}
    inputs, _, early, _ = roll_out("Power-v1", 4, options=options)
    assert early == 0
    energy = (inputs**2).sum(axis=0) / (128 * 0.0222**2)
    assert np.all(energy <= 1 + 1e-4)
    assert np.all(energy > 0.95)
    # A burst: half of the energy within a third of the time.
    windows = [(inputs[t : t + 43] ** 2).sum(axis=0) for t in range(86)]
    assert np.all(np.max(windows, axis=0) > 0.5 * (inputs**2).sum(axis=0))


@table("track", ["Short-v0", "Short-v1"])
def test_the_margin_is_the_quantile_of_the_risk_in_an_episode(track):
    """Outputs that all lie at the margin exceed the limit with probability ``risk`` in an episode."""
    env, freedom = gym.make(f"duffing_env/{track}"), 4 + (2 + np.arange(48) / 16) ** 2
    for risk in (0.05, 0.5):
        margin = make_policy("efe", env, risk=risk).objective.margin
        np.testing.assert_allclose(margin, t(freedom).isf(risk / 48), rtol=1e-12)


#: Of about 27 samples in a period, and of Eq. (1), whose planner the tests of runs compile.
SLOW_RIG = {
    "step": 1e-3, "input": {"unit": "N", "limit": 20.0}, "output": {"unit": "m", "range": 0.01},
    "guess": {"m": (0.38, 0.42), "c": (5.0, 8.0), "a": (2.1e4, 2.3e4), "b": (0.5e8, 2e8)},
}  # fmt: skip


def test_on_a_rig_moves_of_several_samples_become_shorter_towards_the_end():
    options = {"rig": SLOW_RIG, "horizon": 60, "noise_hypotheses": 1}
    envs = make("Rig", 3, **options)
    policy = make_policy("efe", envs, seed=0)
    observations, _ = envs.reset(seed=0)
    state, moves, left, gains = None, [], np.zeros(3), np.zeros(3)
    for _ in range(envs.horizon):
        begun = left == 0
        actions, state = policy.predict(observations, state)
        if begun.all():
            moves.append(state.remaining_holds + 1)
        left = state.remaining_holds
        observations, rewards, terminated, *_ = envs.step(actions)
        assert not terminated.any()
        gains += rewards
    lengths = np.array(moves)
    assert (lengths == lengths[:, :1]).all(), "all plan at the same samples"
    assert lengths[0, 0] == policy.objective.hold_samples == 3
    assert (np.diff(lengths[:, 0]) <= 0).all()
    assert set(lengths[:, 0].tolist()) == {1, 3}
    assert lengths[:, 0].sum() == envs.horizon
    *_, chance = roll_out("Rig", 3, options=options, name="prbs")
    assert gains.mean() > chance.mean() + 0.5


def precisions(belief, plan):
    """(moves + 1, 4, 4) inverse covariances of the coefficients of Eq. (2) before and after each move, in matrices."""
    P, z, theta = belief.record[covariance_indices(belief.model)], belief.state_mean, belief.coefficients_mean
    q, r = belief.noises[1] / belief.noises[0], belief.noises[3] / belief.noises[2]
    known = [np.linalg.inv(P[2:, 2:])]
    for u in plan:
        S = np.eye(6)
        S[0] = [theta[0] + 3 * theta[1] * z[0] ** 2, theta[2], z[0], z[0] ** 3, z[1], u]
        S[1] = [1, 0, 0, 0, 0, 0]
        P = S @ P @ S.T
        P[0, 0] += q
        P = P - np.outer(P[:, 0], P[0]) / (P[0, 0] + r)
        z = np.array([theta @ [z[0], z[0] ** 3, z[1], u], z[0]])
        known.append(np.linalg.inv(P[2:, 2:]))
    return np.array(known)


def random_belief(rng):
    """A belief about Eq. (2) near the tracks' beliefs."""
    coefficients = np.array([1.8, -0.4, -0.93, 0.38])
    scale = np.concatenate([[0.02, 0.02], 0.03 * np.abs(coefficients)])
    factor = np.eye(6) + 0.3 * np.tril(rng.normal(0, 1, (6, 6)), -1)
    cov = np.outer(scale, scale) * (factor @ factor.T)
    state = rng.uniform(0.1, 0.3, 2) * [1, 0.5]
    noises = (2.0, 2.0 * 0.01**2), (3.0, 3.0 * 0.02**2)
    return Belief.of(difference(), np.concatenate([state, coefficients]), cov, *noises)


@table("left", [4, 200])
def test_no_plan_of_full_inputs_scores_higher_than_the_plan_found(left):
    horizon = 4
    # The information after one, two and four moves counts; a plan to the end scores the information there.
    weights = np.array([1.0, 1.0, 0.0, 1.0]) if left > horizon else np.array([0.0, 0.0, 0.0, 1.0])
    terms = PlanObjective(0.15, np.inf, 10.0, np.full(left, 2.0), walk=np.zeros(4), scales=np.ones(2))
    for seed in range(4):
        rng = np.random.default_rng(seed)
        belief = random_belief(rng)
        rate = 0.1 * np.linalg.inv(belief.coefficients_cov)
        plans, others = np.zeros((2, 1, horizon))
        rates, words = rate[None].copy(), rng.integers(1, 2**63, (1, 4), dtype=np.uint64)
        arguments = belief.record[None].copy(), np.array([left]), horizon, 60, terms, np.zeros((1, 2))
        compile_receding_horizon(difference()).plan(
            *arguments, PlanArrays(plans, others, rates, words, np.empty(1), np.empty(1, dtype=np.int64))
        )

        def worth(inputs, belief=belief, rate=rate):
            to_come = (left - 1 - np.arange(horizon))[:, None, None] * rate
            return 0.5 * np.linalg.slogdet(precisions(belief, inputs)[1:] + to_come)[1] @ weights

        best = max(worth(inputs) for inputs in itertools.product((-0.15, 0.0, 0.15), repeat=horizon))
        assert worth(plans[0]) >= best - 1e-4


@pytest.mark.parametrize(("track", "moves"), [("Amplitude-v0", 44), ("Short-v0", 24)])
def test_the_information_rate_after_a_plan_is_the_rate_of_its_last_moves(track, moves):
    """Against Eq. (2) in matrices: the information of the last 25 moves, or of all where there are fewer."""
    envs = make(track, 3)
    policy = make_policy("efe", envs, seed=0)
    observations, _ = envs.reset(seed=4)
    _, state = policy.predict(observations)
    for i, plan in enumerate(state.plans):
        known = precisions(envs.belief(i), plan[:moves])
        counted = min(25, moves)
        np.testing.assert_allclose(state.information_rates[i], (known[-1] - known[-1 - counted]) / counted, rtol=1e-6)


def test_information_of_later_moves_is_discounted():
    """No plan of eight full inputs scores higher than the plan found, by Eq. (2) in matrices."""
    envs = make("Output", 8, max_output=2.0)
    envs.reset(seed=5)
    for action in np.random.default_rng(6).choice([-1.0, 1.0], (24, 8, 1)).astype(np.float32):
        observations, *_ = envs.step(action)
    policy = make_policy("efe", envs, horizon=8)
    _, state = policy.predict(observations)
    others = 0
    for i, found in enumerate(state.plans):
        belief = envs.belief(i)
        q, r = belief.noises[1] / belief.noises[0], belief.noises[3] / belief.noises[2]
        weights = np.append(np.exp(-np.arange(8) / (6 + 4 * (r / q) ** 0.25)), 0.0)

        def known(plan, belief=belief):
            return 0.5 * np.linalg.slogdet(precisions(belief, plan)[1:])[1]

        tried = np.array(
            [known(plan) for plan in itertools.product(policy.objective.amplitude * np.array([-1, 1]), repeat=8)]
        )
        worths = tried @ -np.diff(weights)
        little = 5e-3 * np.ptp(worths)
        assert known(found) @ -np.diff(weights) > worths.max() - little
        others += worths[np.argmax(tried[:, -1])] < worths.max() - 2 * little
    assert others > 0  # the end alone would have chosen other plans


def test_blocks_begin_with_the_episode_in_a_batch():
    """Where a step only begins the next episode, no block goes into it."""
    envs = gym.make_vec("duffing_env/Short-v0", 2, vectorization_mode="vector_entry_point", horizon=24)
    policy = make_policy("efe-block-16", envs)
    observations, _ = envs.reset(seed=0)
    state, played = None, []
    for _ in range(2 * 25):
        actions, state = policy.predict(observations, state)
        observations, _, terminated, _, _ = envs.step(actions)
        assert not terminated.any()
        played.append(actions[:, 0])
    first, over, second = np.split(np.array(played), [24, 25])
    np.testing.assert_array_equal(over, 0.0)
    for episode in (first, second[:24]):
        assert (np.abs(episode).max(axis=0) > 0.5).all()
        assert (np.count_nonzero(episode[:16], axis=0) > 12).all()


def test_a_safe_block_is_scaled_towards_the_limit(monkeypatch):
    """The scaled block has more information, and is as safe."""
    env = gym.make("duffing_env/Short-v0", max_output=0.3).unwrapped
    observation, _ = env.reset(seed=0)
    by_bisections = {}

    def best_block(view, systems, futures, candidates, amplitude, bound, played):
        found = chance_constrained_block.optimise_block(view, systems, futures, candidates, amplitude, bound, played)
        by_bisections[chance_constrained_block._N_BISECTIONS] = chance_constrained_block.expected_information(
            view, systems, futures.limit, found[0]
        )[0]
        assert found[1] == 1.0
        assert found[2] < bound
        return found

    monkeypatch.setattr(block_planner, "optimise_block", best_block)
    for halvings in (0, chance_constrained_block._N_BISECTIONS):
        monkeypatch.setattr(chance_constrained_block, "_N_BISECTIONS", halvings)
        BlockPlanner(env, block=24, risk=0.1).predict(observation)
    never, often = by_bisections.values()
    assert often > never + 0.02
