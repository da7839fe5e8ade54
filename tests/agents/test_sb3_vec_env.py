"""The adapter for Stable-Baselines3, against its own `DummyVecEnv` of single environments."""

import gymnasium as gym
import numpy as np
import pytest
from rounding import U32
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv

from agents import make_policy
from agents.sb3_vec_env import DuffingVecEnv
from duffing_env.batch import spawn_seeds
from estimator import Parameters

TRACK = "duffing_env/Amplitude-v0"
CONTINUOUS = "duffing_env/Amplitude-v1"
HORIZON = 24
# A limit that about half of the episodes reach before their horizon.
OPTIONS = {"horizon": HORIZON, "max_output": 0.22}
GAINS = ("information_gain", "log_posterior_gain", "diverged")
TIME_LEFT = 20  # entry of the observation


def reference(rows, seed, track=TRACK, **options):
    """A `DummyVecEnv` whose environments are seeded as the rows of a batch."""
    envs = DummyVecEnv([lambda: Monitor(gym.make(track, **options)) for _ in range(rows)])
    envs._seeds = spawn_seeds(seed, rows)
    return envs


def random_actions(rows, steps, seed=0):
    return np.random.default_rng(seed).uniform(-1.2, 1.2, (steps, rows, 1)).astype(np.float32)


@pytest.mark.parametrize(
    ("track", "rows", "reward"),
    [(TRACK, 3, "information_gain"), (TRACK, 37, "log_posterior"), (CONTINUOUS, 6, "information_gain")],
)
def test_steps_are_those_of_single_environments(track, rows, reward):
    ours = DuffingVecEnv(track, rows, seed=5, reward=reward, **OPTIONS)
    theirs = reference(rows, 5, track, reward=reward, **OPTIONS)
    np.testing.assert_array_equal(ours.reset(), theirs.reset())
    assert ours.reset_infos == theirs.reset_infos
    limits_reached, times_up, prior = 0, 0, ours.envs.belief(0)
    for actions in random_actions(rows, 3 * HORIZON):
        observations, rewards, dones, infos = ours.step(actions)
        expected_observations, expected_rewards, expected_dones, expected_infos = theirs.step(actions)
        np.testing.assert_array_equal(observations, expected_observations)
        np.testing.assert_array_equal(rewards, expected_rewards)
        np.testing.assert_array_equal(dones, expected_dones)
        assert (observations.dtype, rewards.dtype, dones.dtype) == (np.float32, np.float32, np.bool_)
        assert ours.reset_infos == theirs.reset_infos
        for done, info, expected in zip(dones, infos, expected_infos, strict=True):
            if not done:
                assert info == expected
                assert [type(value) for value in info.values()] == [type(value) for value in expected.values()]
                continue
            assert info.keys() - expected.keys() == {"belief", "truth"}
            np.testing.assert_array_equal(info["terminal_observation"], expected["terminal_observation"])
            assert info["TimeLimit.truncated"] is expected["TimeLimit.truncated"]
            assert {name: info[name] for name in GAINS} == {name: expected[name] for name in GAINS}
            assert isinstance(info["truth"], Parameters)
            assert info["belief"].entropy() < prior.entropy()
            assert info["episode"]["l"] == expected["episode"]["l"]
            assert info["episode"]["r"] == pytest.approx(expected["episode"]["r"], abs=1e-6)  # Monitor rounds to that
            limits_reached += not info["TimeLimit.truncated"]
            times_up += info["TimeLimit.truncated"]
    assert limits_reached >= rows // 2
    assert times_up >= rows // 2


def test_only_a_time_limit_is_truncated():
    rows = 16
    envs = DuffingVecEnv(TRACK, rows, seed=3, **OPTIONS)
    envs.reset()
    lengths = {True: [], False: []}
    for actions in random_actions(rows, 4 * HORIZON, seed=1):
        _, _, dones, infos = envs.step(actions)
        for row in np.flatnonzero(dones):
            time_is_up, last = infos[row]["TimeLimit.truncated"], infos[row]["terminal_observation"]
            beyond_limit = abs(last[19]) > 1.0  # the last output in parts of max_output
            assert time_is_up is not bool(beyond_limit)
            lengths[time_is_up].append(infos[row]["episode"]["l"])
            assert last[TIME_LEFT] == pytest.approx(1 - lengths[time_is_up][-1] / HORIZON, abs=U32)
    assert set(lengths[True]) == {HORIZON}
    assert min(lengths[False]) < HORIZON


def test_an_episode_sums_its_own_rewards_only():
    envs = DuffingVecEnv(TRACK, 8, seed=2, **OPTIONS)
    envs.reset()
    episodes, earned = 0, [[] for _ in range(8)]
    for actions in random_actions(8, 4 * HORIZON, seed=2):
        _, rewards, dones, infos = envs.step(actions)
        for row in range(8):
            earned[row].append(float(rewards[row]))
            if dones[row]:
                slack = U32 * np.abs(earned[row]).sum()  # every reward has been rounded to float32, but not in the sum
                assert infos[row]["episode"]["r"] == pytest.approx(sum(earned[row]), rel=0, abs=1.01 * slack)
                assert infos[row]["episode"]["l"] == len(earned[row])
                assert infos[row]["episode"]["t"] >= 0.0
                earned[row], episodes = [], episodes + 1
    assert episodes >= 32


def test_a_reset_begins_all_counts_anew():
    envs = DuffingVecEnv(TRACK, 4, seed=2, horizon=HORIZON)
    envs.reset()
    for actions in random_actions(4, 10):
        envs.step(actions)
    envs.reset()
    for actions in random_actions(4, HORIZON):
        _, _, dones, infos = envs.step(actions)
    assert dones.all()
    assert [info["episode"]["l"] for info in infos] == [HORIZON] * 4


def test_what_is_handed_out_is_a_copy():
    """Keeping it is safe, and so is writing to it."""
    undisturbed, disturbed = (DuffingVecEnv(TRACK, 5, seed=7, **OPTIONS) for _ in range(2))
    kept = [undisturbed.reset()]
    before = [kept[0].copy()]
    disturbed.reset()[:] = np.nan
    for actions in random_actions(5, 2 * HORIZON, seed=3):
        observations, rewards, dones, infos = undisturbed.step(actions)
        twins = disturbed.step(actions.copy())
        for ours, theirs in zip((observations, rewards, dones), twins, strict=False):
            np.testing.assert_array_equal(ours, theirs)
            theirs[:] = True if theirs.dtype == np.bool_ else np.nan
        finals = [info["terminal_observation"] for info in infos if "terminal_observation" in info]
        for info in twins[3]:
            if "terminal_observation" in info:
                info["terminal_observation"][:] = np.nan
            info["episode"] = None
        kept += [observations, rewards, dones, *finals]
        before += [array.copy() for array in (observations, rewards, dones, *finals)]
    for now, then in zip(kept, before, strict=True):
        np.testing.assert_array_equal(now, then)


def test_the_seed_holds_for_the_next_reset_only():
    envs = DuffingVecEnv(TRACK, 3, seed=4, **OPTIONS)

    def first_outputs():
        envs.reset()
        return envs.step(np.ones((3, 1), dtype=np.float32))[0][:, 19].tolist()

    first, second = first_outputs(), first_outputs()
    assert first != second
    assert envs.seed(4) == [4, 4, 4]
    assert [first_outputs(), first_outputs()] == [first, second]
    envs.seed(5)
    assert first_outputs() not in (first, second)


def test_what_stable_baselines_asks_of_its_environments():
    envs = DuffingVecEnv(TRACK, 4, seed=0, max_input=0.1, **OPTIONS)
    assert envs.num_envs == 4
    assert envs.observation_space == gym.make(TRACK).observation_space
    assert envs.action_space == gym.make(TRACK).action_space
    envs.reset()
    nothing = {"information_gain": 0.0, "log_posterior_gain": 0.0, "diverged": False}
    assert envs.reset_infos == [nothing] * 4
    envs.reset_infos[0]["mark"] = 1
    assert envs.reset_infos[1] == nothing
    envs.reset()
    assert envs.reset_infos == [nothing] * 4
    assert envs.get_attr("max_input") == [0.1] * 4
    assert envs.get_attr("horizon", indices=[0, 2]) == [HORIZON] * 2
    assert envs.env_is_wrapped(Monitor) == [True] * 4
    assert envs.env_is_wrapped(gym.Wrapper, indices=1) == [False]
    (belief,) = envs.env_method("belief", 3, indices=0)
    np.testing.assert_array_equal(belief.record, envs.envs.belief(3).record)
    with pytest.raises(ValueError, match=r"unexpected keyword argument 'max_inputs'.*did you mean 'max_input'"):
        DuffingVecEnv(TRACK, 4, max_inputs=3)


def test_attributes_are_those_of_the_rows_that_are_asked_for():
    envs = DuffingVecEnv(TRACK, 4, seed=0, **OPTIONS)
    envs.reset()
    (truth,) = envs.get_attr("truth", indices=2)
    assert truth == envs.envs._batch.truth_of(2)
    assert type(truth.m) is float
    assert [belief.record.tolist() for belief in envs.get_attr("belief", [1, 3])] == envs.envs.records[[1, 3]].tolist()
    np.testing.assert_array_equal(envs.get_attr("records")[3], envs.envs.records[3])
    with pytest.raises(AttributeError, match="nothing_like_it"):
        envs.get_attr("nothing_like_it")


SOFT, STIFF = ({"m": 6.5e-6, "c": 2.6e-4, "a": 1.2, "b": b} for b in (0.5, 3.0))


@pytest.mark.parametrize("options", [{"truth": SOFT}, [{"truth": SOFT}, {}, {"truth": STIFF}]], ids=["all", "each"])
def test_options_hold_for_the_next_reset_only(options):
    ours, theirs = DuffingVecEnv(TRACK, 3, seed=5, **OPTIONS), reference(3, 5, **OPTIONS)
    for envs in (ours, theirs):
        envs.set_options(options)
    for k, _ in enumerate(range(3)):
        np.testing.assert_array_equal(ours.reset(), theirs.reset())
        assert ours.get_attr("truth") == theirs.get_attr("truth")
        assert (ours.get_attr("truth")[0].b == 0.5) == (k == 0)
    for wrong, message in ({"trth": SOFT}, "options of reset must be among"), ([{}], "options must be a dict, or 3"):
        ours.set_options(wrong)
        with pytest.raises(ValueError, match=message):
            ours.reset()


@pytest.mark.parametrize("name", ["max_output", "reward", "terminated_return", "horizon", "hold", "branch", "levels"])
def test_options_are_not_set(name):
    envs = DuffingVecEnv(TRACK, 3, seed=5, **OPTIONS)
    with pytest.raises(AttributeError, match=f"^{name} cannot be set to 0.3 in .* make a new one with {name}="):
        envs.set_attr(name, 0.3, indices=1)
    envs.set_attr("stage", 1)
    envs.set_attr("stage", 2, indices=[1])
    envs.set_attr("mark", 3, indices=0)
    assert envs.get_attr("stage") == [1, 2, 1]
    assert envs.get_attr("mark", 0) == [3]
    with pytest.raises(AttributeError, match="mark"):
        envs.get_attr("mark")


def test_a_made_environment_may_be_wrapped():
    made = gym.make_vec(TRACK, num_envs=3, autoreset_mode="SameStep", **OPTIONS)
    wrapped = DuffingVecEnv(gym.wrappers.vector.TransformReward(made, lambda reward: 2 * reward), seed=5)
    plain = DuffingVecEnv(TRACK, 3, seed=5, **OPTIONS)
    np.testing.assert_array_equal(wrapped.reset(), plain.reset())
    for actions in random_actions(3, 2 * HORIZON):
        ours, theirs = wrapped.step(actions), plain.step(actions)
        np.testing.assert_array_equal(ours[0], theirs[0])
        np.testing.assert_array_equal(ours[1], 2 * theirs[1])
    assert wrapped.get_attr("horizon", 0) == [HORIZON]
    for other, options in ((gym.make_vec(TRACK, num_envs=3), {}), (gym.make_vec("CartPole-v1", num_envs=2), {})):
        with pytest.raises(ValueError, match=r"env must be the id of a track, or be made with gym\.make_vec"):
            DuffingVecEnv(other, **options)
    with pytest.raises(ValueError, match="num_envs and options must be left out"):
        DuffingVecEnv(made, 4)


def parameters(model):
    return np.concatenate([value.detach().numpy().ravel() for value in model.policy.parameters()])


def test_an_action_by_its_number_is_that_input():
    chosen, free = (DuffingVecEnv("duffing_env/Amplitude-v0", 3, seed=1, levels=levels) for levels in (5, 0))
    assert chosen.action_space == gym.spaces.Discrete(5)
    np.testing.assert_array_equal(chosen.reset(), free.reset())
    for numbers in ([0, 1, 2], [3, 4, 0]):
        actions = np.linspace(-1, 1, 5, dtype=np.float32)[numbers][:, None]
        for one, other in zip(chosen.step(np.array(numbers))[:3], free.step(actions)[:3], strict=True):
            np.testing.assert_array_equal(one, other)


def test_ppo_learns_on_it():
    envs = DuffingVecEnv(TRACK, 8, seed=0, **OPTIONS)
    model = PPO("MlpPolicy", envs, n_steps=64, batch_size=128, policy_kwargs={"net_arch": [8]}, seed=0, device="cpu")
    before = parameters(model)
    model.learn(1024)
    after = parameters(model)
    assert model.num_timesteps == 1024
    assert np.isfinite(after).all()
    assert not np.array_equal(before, after)
    lengths = {episode["l"] for episode in model.ep_info_buffer}
    assert max(lengths) == HORIZON
    assert len(lengths) > 1


def test_sac_learns_on_it_from_the_right_transitions():
    envs = DuffingVecEnv(TRACK, 4, seed=0, **OPTIONS)
    model = SAC(
        "MlpPolicy", envs, buffer_size=4000, learning_starts=100, batch_size=32, gradient_steps=1,
        policy_kwargs={"net_arch": [8]}, seed=0, device="cpu",
    )  # fmt: skip
    before = parameters(model)
    model.learn(400)
    assert np.isfinite(parameters(model)).all()
    assert not np.array_equal(before, parameters(model))
    buffer, filled = model.replay_buffer, slice(model.replay_buffer.pos)
    time_left = buffer.next_observations[filled, :, TIME_LEFT]
    steps_on = buffer.observations[filled, :, TIME_LEFT] - time_left
    np.testing.assert_allclose(steps_on, 1 / HORIZON, rtol=0, atol=3 * U32)  # never into the next episode
    np.testing.assert_array_equal(buffer.timeouts[filled], time_left == 0.0)
    dones, timeouts = buffer.dones[filled].sum(), buffer.timeouts[filled].sum()
    assert dones > timeouts > 0


@pytest.mark.parametrize("name", ["prbs", "silverbox-arrow"])
def test_evaluate_policy_plays_a_signal_sample_by_sample(name):
    rows, options = 3, {"horizon": HORIZON, "max_output": 2.0}
    envs = DuffingVecEnv(TRACK, rows, seed=6, **options)
    returns, lengths = evaluate_policy(
        make_policy(name, envs.envs, seed=1), envs, n_eval_episodes=rows, return_episode_rewards=True
    )
    played, state = [], None
    policy = make_policy(name, envs.envs, seed=1)
    for _ in range(HORIZON):
        actions, state = policy.predict(np.zeros((rows, 22)), state)
        played.append(actions)
    assert lengths == [HORIZON] * rows
    for row, seed in enumerate(spawn_seeds(6, rows)):
        env = gym.make(TRACK, **options)
        env.reset(seed=seed)
        assert returns[row] == pytest.approx(sum(env.step(actions[row])[1] for actions in played), rel=1e-12)


def test_evaluate_policy_evaluates_a_model():
    options = {"horizon": HORIZON, "max_output": 2.0}
    envs = DuffingVecEnv(TRACK, 3, seed=8, **options)
    model = PPO("MlpPolicy", envs, n_steps=8, batch_size=24, policy_kwargs={"net_arch": [8]}, seed=0, device="cpu")
    envs.seed(9)
    returns, lengths = evaluate_policy(model, envs, n_eval_episodes=3, return_episode_rewards=True)
    assert lengths == [HORIZON] * 3
    singles = [gym.make(TRACK, **options) for _ in range(3)]
    observations = [env.reset(seed=seed)[0] for env, seed in zip(singles, spawn_seeds(9, 3), strict=True)]
    earned = []
    for _ in range(HORIZON):
        # All rows at once, as there: a product of matrices rounds by its size.
        actions, _ = model.predict(np.array(observations), deterministic=True)
        steps = [env.step(action) for env, action in zip(singles, actions, strict=True)]
        observations = [step[0] for step in steps]
        earned.append([step[1] for step in steps])
    np.testing.assert_allclose(returns, np.sum(earned, axis=0), rtol=1e-12)


@pytest.mark.parametrize(
    ("track", "options"),
    [
        ("Short-v0", {}),
        ("Short-v1", {"horizon": 12}),
        ("Drift-v0", {"horizon": 12}),
        ("Pendulum-v0", {"horizon": 12}),
        ("Short-v0", {"observation": "history", "history": 3, "hold": 2, "input_cost": 0.1}),
        ("Short-v0", {"observation": "privileged", "reward": lambda before, after, u, y, truth: u * y / truth["m"]}),
    ],
)
def test_episodes_go_on_in_other_environments_from_a_copy_of_the_memory(track, options):
    rng = np.random.default_rng(0)
    one, other = (DuffingVecEnv(f"duffing_env/{track}", 11, seed=seed, **options) for seed in (0, 1))
    one.reset()
    for _ in range(7):
        seen, *_ = one.step(rng.uniform(-1, 1, (11, 1)).astype(np.float32))
    copied = {name: array.copy() for name, array in one.episode_state.items()}
    np.testing.assert_array_equal(other.restore_episode_state(copied), seen)
    for _ in range(70):
        actions = rng.uniform(-1, 1, (11, 1)).astype(np.float32)
        (seen, rewards, dones, infos), (*others, other_infos) = one.step(actions), other.step(actions)
        for mine, its in zip((seen, rewards, dones), others, strict=True):
            np.testing.assert_array_equal(mine, its)
        assert [t.get("episode", {}).get("r") for t in infos] == [t.get("episode", {}).get("r") for t in other_infos]
