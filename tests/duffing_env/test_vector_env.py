"""The vector environment: Gymnasium's vector contract. That rows are single environments is in tests/contract."""

import numpy as np
import pytest
from gymnasium.error import ResetNeeded
from gymnasium.vector import AutoresetMode
from playing import BY_HAND, MODES, assert_refused, assert_same, random_actions, roll_out, same

from duffing_env.batch import spawn_seeds
from duffing_env.env import DuffingEnv
from duffing_env.storage.random_streams import SEED_BRANCHES
from duffing_env.vector_env import DuffingVectorEnv

TRACK = "duffing_env/Amplitude-v0"
# Random inputs end about half of such episodes at the limit, the others at the horizon.
BOTH_ENDS = {"horizon": 20, "max_output": 0.17}
PARAMETERS = ("m", "c", "a", "b")


def test_rows_that_are_being_reset_wait():
    envs = DuffingVectorEnv(33, **BOTH_ENDS)
    first, _ = envs.reset(seed=0)
    being_reset, waited = np.zeros(33, dtype=bool), 0
    for action in random_actions(100, 33):
        observations, rewards, terminated, truncated, infos = envs.step(action)
        assert not (terminated & truncated).any()
        np.testing.assert_array_equal(rewards[being_reset], 0.0)
        assert not (terminated | truncated)[being_reset].any()
        np.testing.assert_array_equal(observations[being_reset], first[being_reset])
        for name in ("information_gain", "log_posterior_gain", "diverged"):
            assert infos[f"_{name}"].all()
            assert not infos[name][being_reset].any()
        waited += being_reset.sum()
        being_reset = terminated | truncated
    assert waited > 100


@pytest.mark.parametrize("mode", MODES)
def test_an_episode_ends_with_its_own_belief_and_truth(mode):
    envs = DuffingVectorEnv(3, autoreset_mode=mode, horizon=4)
    envs.reset(seed=0)
    prior, truth = envs.belief(0), envs.truth
    for action in random_actions(4, 3):
        observations, _, _, truncated, infos = envs.step(action)
    assert truncated.all()
    same_step = mode == AutoresetMode.SAME_STEP
    endings, final = (infos["final_info"], infos["final_obs"]) if same_step else (infos, observations)
    for row in range(3):
        for name in PARAMETERS:
            assert getattr(endings["truth"][row], name) == getattr(truth, name)[row]
        belief = endings["belief"][row]
        variances = [b.coefficients_cov[3, 3] for b in (belief, prior)]
        np.testing.assert_allclose(final[row][7], 0.5 * np.log(variances[0] / variances[1]), rtol=1e-6)
        assert belief.entropy() < prior.entropy()
        assert final[row][20] == 0.0
    assert (envs.truth.m == truth.m).all() != same_step


def test_copies_are_returned_by_default():
    action = np.ones((2, 1), dtype=np.float32)
    envs = DuffingVectorEnv(2)
    first, _ = envs.reset(seed=0)
    kept = first.copy()
    second = envs.step(action)[0]
    np.testing.assert_array_equal(first, kept)
    assert not np.shares_memory(first, second)

    envs = DuffingVectorEnv(2, copy=False)
    first, _ = envs.reset(seed=0)
    np.testing.assert_array_equal(first, kept)
    step = envs.step(action)
    np.testing.assert_array_equal(step[0], second)
    assert step[0] is first
    kept = [part.copy() for part in step[1:4]]
    envs.step(action)
    assert_same(list(step[1:4]), kept)


def test_metadata_is_each_environments_own():
    with_modes = [DuffingVectorEnv(1, autoreset_mode=mode) for mode in MODES]
    assert [envs.metadata["autoreset_mode"] for envs in with_modes] == MODES
    assert [envs.autoreset_mode for envs in with_modes] == MODES
    assert DuffingVectorEnv.metadata["autoreset_mode"] == AutoresetMode.NEXT_STEP
    assert DuffingVectorEnv(1, autoreset_mode="SameStep").metadata["autoreset_mode"] == AutoresetMode.SAME_STEP
    with_modes[0].metadata["render_fps"] = 1
    assert "render_fps" not in DuffingVectorEnv.metadata
    assert "autoreset_mode" not in DuffingEnv.metadata


def test_seeds():
    def start(seed, rows=3):
        envs = DuffingVectorEnv(rows)
        envs.reset(seed=seed)
        return envs.truth.m

    np.testing.assert_array_equal(start(5), start(spawn_seeds(5, 3)))
    np.testing.assert_array_equal(start(5), start(np.int64(5)))
    np.testing.assert_array_equal(start([1, 2, 3]), start(np.array([1, 2, 3])))
    assert start([1, 2, 3])[1] == start([2, 2, 2])[0]
    # Neighbouring seeds of a batch share no row, which `seed + i` would make them do.
    assert len(np.unique(np.concatenate([start(seed, 50) for seed in range(10)]))) == 500
    assert len(np.unique(np.concatenate([start(None), start(None)]))) == 6

    envs = DuffingVectorEnv(3)
    envs.reset(seed=5)
    envs.reset()
    second = envs.truth.m
    assert not np.isin(second, start(5)).any()
    envs.reset(seed=[None, 8, None])
    third = envs.truth.m
    assert third[1] == start([8] * 3)[1]
    envs.reset(seed=5)
    envs.reset()
    np.testing.assert_array_equal(envs.truth.m, second)
    envs.reset()
    np.testing.assert_array_equal(envs.truth.m[[0, 2]], third[[0, 2]])
    with pytest.raises(ValueError, match=r"seed must be a whole number or 3 of them, .*, but is \[1, 2\]"):
        envs.reset(seed=[1, 2])


@pytest.mark.parametrize("mode", MODES)
def test_every_row_must_have_begun(mode):
    envs = DuffingVectorEnv(3, autoreset_mode=mode)
    actions = random_actions(1, 3)[0]
    with pytest.raises(ResetNeeded, match=r"no systems are drawn yet: call reset\(\)"):
        _ = envs.truth
    with pytest.raises(ResetNeeded, match=r"rows \[0, 1, 2\]"):
        envs.step(actions)
    envs.reset(seed=4, options={"reset_mask": np.array([True, False, True])})
    with pytest.raises(ResetNeeded, match=r"rows \[1\]"):
        envs.step(actions)
    envs.reset(options={"reset_mask": np.array([False, True, False])})
    envs.step(actions)
    assert len(np.unique(envs.truth.m)) == 3
    expected = DuffingVectorEnv(3)
    expected.reset(seed=4)
    np.testing.assert_array_equal(envs.truth.m[[0, 2]], expected.truth.m[[0, 2]])


def test_finished_rows_are_reset_by_hand():
    envs = DuffingVectorEnv(2, autoreset_mode=BY_HAND, horizon=3)
    envs.reset(seed=0)
    actions = random_actions(3, 2)
    envs.step(actions[0])
    envs.reset(options={"reset_mask": np.array([False, True])})
    for action in actions[1:]:
        observations, *_, truncated, _ = envs.step(action)
    assert truncated.tolist() == [True, False]
    with pytest.raises(ResetNeeded, match=r"rows \[0\] .*reset_mask"):
        envs.step(actions[0])
    options = {"reset_mask": np.array([True, False])}
    again, infos = envs.reset(options=options)
    assert {name: value.tolist() for name, value in infos.items() if name[0] == "_"} == {
        f"_{name}": [True, False] for name in ("information_gain", "log_posterior_gain", "diverged")
    }
    assert list(options) == ["reset_mask"]
    np.testing.assert_array_equal(again[1], observations[1])
    assert again[:, 20].tolist() == [1.0, np.float32(1 / 3)]
    envs.step(actions[0])


def test_bad_reset_masks_are_refused():
    envs, true = DuffingVectorEnv(3), np.ones(3, dtype=bool)
    masks = [true[:2], ~true, np.ones(3), [1, 0, 1], true[:, None], None, [[True], [True, False]]]
    message = "reset_mask must be a bool array of shape (3,)"
    assert_refused((lambda mask=mask: envs.reset(options={"reset_mask": mask}), message) for mask in masks)


BAD_ACTIONS = [
    (np.zeros(3), "actions must have shape (3, 1), but have (3,)"),
    (np.zeros((1, 3)), "actions must have shape (3, 1), but have (1, 3)"),
    (np.zeros((2, 1)), "actions must have shape (3, 1), but have (2, 1)"),
    ([[0.0], [np.nan], [0.0]], "actions must be finite, but row 1 is nan"),
    ([[0.0], [0.0], [-np.inf]], "actions must be finite, but row 2 is -inf"),
    ("abc", "actions must be numbers, but is 'abc'"),
    ([[0.0], [0.0], [None, 1.0]], "actions must be numbers, but is"),
    ([[0.0], [0.0], [1j]], "actions must be numbers, but is"),
    (np.ma.masked_array(np.zeros((3, 1)), True), "actions must not be a masked array"),
]


def test_bad_actions_are_refused_and_change_nothing():
    envs, untouched = DuffingVectorEnv(3, **BOTH_ENDS), DuffingVectorEnv(3, **BOTH_ENDS)
    for each in (envs, untouched):
        each.reset(seed=0)
    assert_refused((lambda actions=actions: envs.step(actions), message) for actions, message in BAD_ACTIONS)
    for action in random_actions(30, 3):
        assert same(envs.step(action), untouched.step(action))


BAD_OPTIONS = [
    ({"num_envs": 0}, "num_envs must be a whole number from 1 to 1048576, but is 0"),
    ({"num_envs": 2.0}, "num_envs must be a whole number from 1 to 1048576, but is 2.0"),
    ({"num_envs": 2**31}, "num_envs must be a whole number from 1 to 1048576, but is 2147483648"),
    ({"num_envs": 2**18, "noise_hypotheses": 7}, "num_envs must leave room for 21 beliefs"),
    ({"num_envs": 2**18, "observation": "history", "history": 1000}, "and 2002 observed numbers in each"),
    ({"threads": 0}, "threads must be a whole number from 1 to"),
    ({"threads": 10_000}, "threads must be a whole number from 1 to"),
    ({"autoreset_mode": "later"}, "autoreset_mode must be one of ['NextStep', 'SameStep', 'Disabled']"),
    ({"render_mode": "rgb_array"}, "render_mode must be None"),
    ({"max_episode_steps": 0}, "max_episode_steps must be a whole number from 1"),
    ({"max_episode_steps": "x"}, "max_episode_steps must be a whole number from 1 to 1000000000, but is 'x'"),
]


def test_bad_options_are_refused():
    assert_refused((lambda options=options: DuffingVectorEnv(**options), message) for options, message in BAD_OPTIONS)


def test_what_a_batch_was_made_with_is_not_set():
    envs = DuffingVectorEnv(3, **BOTH_ENDS)
    names = ["num_envs", "threads", "copy", "autoreset_mode", "max_episode_steps", "render_mode", "horizon", "reward"]
    for name in names:
        before = getattr(envs, name)
        with pytest.raises(AttributeError, match=f"^{name} cannot be set to 5 in .* make a new one with {name}="):
            setattr(envs, name, 5)
        assert getattr(envs, name) is before


def test_systems_of_choice_for_some_rows():
    envs, drawn = (DuffingVectorEnv(4, noise_range=10.0, horizon=20) for _ in range(2))
    drawn.reset(seed=3)
    truth = {"m": 7e-6, "c": 2e-4, "a": 1.0, "b": 0.5}
    envs.reset(
        seed=3, options={"truth": [None, truth, None, truth | {"process_noise": 1e-3, "measurement_noise": 2e-3}]}
    )
    for name in drawn.truth:
        found, expected = envs.truth[name].copy(), drawn.truth[name].copy()
        np.testing.assert_array_equal(found[[0, 2]], expected[[0, 2]])
        if name in truth:
            np.testing.assert_allclose(found[[1, 3]], truth[name], rtol=1e-12)
    np.testing.assert_allclose(envs.truth["process_noise"][[1, 3]], [drawn.truth["process_noise"][1], 1e-3], rtol=1e-12)
    for wrong, message in ([truth] * 3, "truth must be one for all environments, or 4 of them, but is 3"), (
        [None, {"m": 1.0}, None, None], r"truth\[1\] must give the parameters"
    ):  # fmt: skip
        with pytest.raises(ValueError, match=message):
            envs.reset(options={"truth": wrong})


@pytest.mark.parametrize("options", [{}, {"noise_range": 10.0}, {"jump": 0.3, "horizon": 40}], ids=str)
def test_a_system_of_choice(options):
    drawn, single = DuffingVectorEnv(40, **options), DuffingEnv(**options)
    actions = random_actions(30, 40)
    expected = roll_out(drawn, actions, 3)
    drawn.reset(seed=3)
    truth = drawn.truth
    # What the seed draws, chosen: the same to the bit, for all rows and for one.
    drawn.reset(seed=99)
    drawn.reset(seed=3, options={"truth": truth})
    assert drawn.truth == truth
    assert_same([drawn.step(action)[:4] for action in actions], [step_results[:4] for step_results in expected[1:]])
    single.reset(seed=spawn_seeds(3, 40)[35], options={"truth": {name: truth[name][35] for name in truth}})
    for action, step_results in zip(actions[:, 35], expected[1:], strict=True):
        step = single.step(action)
        np.testing.assert_array_equal(step[0], step_results[0][35])
        assert step[1] == step_results[1][35]
        if step[2] or step[3]:
            break
    # Only the rows that are reset get another system; their noises stay.
    mask = np.arange(40) < 2
    other = {"m": [7e-6] * 40, "c": 2e-4, "a": 1.0, "b": 0.0}
    drawn.reset(seed=3)
    drawn.reset(seed=3, options={"truth": other, "reset_mask": mask})
    assert drawn.truth.m[:2].tolist() == [7e-6] * 2
    assert drawn.truth.b[:2].tolist() == [0.0] * 2
    for name in truth:
        if name in other:
            np.testing.assert_array_equal(drawn.truth[name][2:], truth[name][2:])
        else:
            np.testing.assert_array_equal(drawn.truth[name], truth[name])
    assert np.isfinite(drawn.step(actions[0])[0]).all()
    assert not drawn.step(actions[0])[4]["diverged"].any()


BAD_RESETS = [
    ({"foo": 1}, "'truth'], but there is 'foo'"),
    ({"truth": 1}, "truth must give the parameters ['m', 'c', 'a', 'b'], but is 1"),
    ({"truth": {"m": 1.0}}, "truth must give the parameters"),
    ({"truth": dict(m=1.0, c=1.0, a=1.0, b=np.inf)}, "truth['b'] must be finite, but is inf"),
    ({"truth": dict(m=1.0, c="x", a=1.0, b=1.0)}, "of them, but is 'x'"),
    ({"truth": dict(m=1.0, c=[1.0] * 2, a=1.0, b=1.0)}, "truth['c'] must be a number, or "),
    ({"truth": dict(m=0.0, c=1.0, a=1.0, b=1.0)}, "truth['m'] must be positive, but is 0.0"),
    (np.array(3), "options of reset must be a dict or None"),
]


def test_bad_options_of_a_reset_are_refused_and_change_nothing():
    for env in (DuffingEnv(), DuffingVectorEnv(3)):
        env.reset(seed=0)
        before = env.truth
        assert_refused(
            (lambda env=env, options=options: env.reset(seed=1, options=options), message)
            for options, message in BAD_RESETS
        )
        assert env.truth == before


def test_the_same_seed_gives_other_experiments_in_each_branch():
    actions = random_actions(20, 6)
    plain, by_branch = DuffingVectorEnv(6), {branch: DuffingVectorEnv(6, branch=branch) for branch in SEED_BRANCHES}
    reference, found = roll_out(plain, actions), {branch: roll_out(envs, actions) for branch, envs in by_branch.items()}
    assert_same(reference, found["train"])
    masses = np.concatenate([envs.truth.m for envs in by_branch.values()])
    assert len(set(masses.tolist())) == 18
    single = DuffingEnv(branch="test")
    single.reset(seed=spawn_seeds(0, 6)[3])
    assert single.truth.m == by_branch["test"].truth.m[3]
    with pytest.raises(ValueError, match="branch must be one of"):
        DuffingEnv(branch="exam")


NO_SEEDS = [[1, 2, -1], [1, 2, 2.5], [1, 2], -1, "seed", 2.5, [1, 2, True], [1, 2, 10**60], (1, 2, "3"), np.array(3)]


def test_an_invalid_seed_changes_nothing():
    envs, untouched = DuffingVectorEnv(3, **BOTH_ENDS), DuffingVectorEnv(3, **BOTH_ENDS)
    for each in (envs, untouched):
        each.reset(seed=0)
    assert_refused((lambda seed=seed: envs.reset(seed=seed), "must be a whole number") for seed in NO_SEEDS)
    for action in random_actions(5, 3):
        assert same(envs.step(action), untouched.step(action))
    np.testing.assert_array_equal(envs.reset()[0], untouched.reset()[0])
    assert envs.np_random.bit_generator.state == untouched.np_random.bit_generator.state
