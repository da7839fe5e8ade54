"""Training on drawn options: groups of rows, each with options of its own."""

from functools import partial

import numpy as np
import pytest
from tables import table

from agents.training import PPOSettings, TrainConfig, resume, train
from agents.training.environments.feature_vec_env import REWARD_SCALE
from agents.training.environments.randomised_vec_env import MixedVecEnv, draw_track_options
from agents.training.environments.training_envs import draw_family_options
from estimator.compilation.simd import LANES

TRACK = "duffing_env/Power-v0"
LENGTHS = {"horizon": [16, 64]}
RANGES = {"max_rms": [0.01, 0.1], **LENGTHS}
DRAW = partial(draw_track_options, env_id=TRACK, options={}, ranges=RANGES)
TINY = PPOSettings(num_envs=LANES, n_steps=8, batch_size=64, hidden=(4,))


def config(**settings):
    return TrainConfig(**{"env": TRACK, "steps": 512, "vary": RANGES, "hyperparameters": TINY, **settings})


def test_options_are_drawn_over_their_whole_range():
    rng = np.random.default_rng(0)
    drawn = [DRAW(rng)[1] for _ in range(400)]
    lengths, powers = ([options[name] for options in drawn] for name in ("horizon", "max_rms"))
    assert all(isinstance(length, int) for length in lengths)
    assert (min(lengths), max(lengths)) == (16, 64)
    assert 0.01 <= min(powers) < 0.011 < 0.09 < max(powers) <= 0.1
    assert np.mean(np.log10(powers)) == pytest.approx(-1.5, abs=0.06)  # four deviations of such a mean


def test_every_group_has_its_own_options_and_draws_anew():
    envs = MixedVecEnv(4 * LANES, 3, DRAW, raw_observation=True)
    lengths = [group.envs.horizon for group in envs._groups]
    assert len(set(lengths)) > 1
    envs.reset()
    ends = np.zeros(4 * LANES)
    for t in range(1, max(lengths) + 1):
        _, rewards, dones, infos = envs.step(np.zeros((4 * LANES, 1)))
        assert np.isfinite(rewards).all()
        ends = np.where(dones & (ends == 0), t, ends)
        assert all(("terminal_observation" in info) == done for info, done in zip(infos, dones, strict=True))
    assert ends.reshape(4, LANES)[:, 0].tolist() == lengths
    assert [group.envs.horizon for group in envs._groups] != lengths
    envs.close()


@table("track", [TRACK, "duffing_env/Amplitude-v0"])
def test_an_episode_adds_up_to_what_it_gained(track):
    """What is still to come adds its potential, where the energy has no limit, once to every episode of a group."""
    envs = MixedVecEnv(
        LANES, 5, partial(draw_track_options, env_id=track, options={}, ranges=LENGTHS), raw_observation=True
    )
    envs.reset()
    to_come = (track != TRACK) * envs._groups[0].current_features.remaining_information
    total = np.zeros(LANES)
    for _ in range(envs._groups[0].envs.horizon):
        _, rewards, dones, infos = envs.step(np.zeros((LANES, 1)))
        total += rewards
    assert dones.all()
    gained = np.array([info["episode"]["r"] for info in infos])
    assert total == pytest.approx(REWARD_SCALE * (gained - to_come), abs=2e-3)
    envs.close()


@pytest.mark.parametrize("draw", [DRAW, draw_family_options], ids=["track", "family"])
def test_the_same_seed_gives_the_same_episodes(draw):
    def episodes(seed):
        envs = MixedVecEnv(LANES, seed, draw)
        seen = [envs.reset(), *(envs.step(np.ones((LANES, 1)))[0] for _ in range(5))]
        envs.close()
        return np.array(seen)

    assert np.array_equal(episodes(1), episodes(1))
    assert not np.array_equal(episodes(1), episodes(2))


def test_a_run_says_what_it_varied_and_goes_on(tmp_path):
    run = train(config(output=tmp_path / "run"))
    assert run.config.vary == RANGES
    with pytest.raises(ValueError, match="finished"):
        resume(run.folder)


@table(
    ("settings", "named"),
    [
        ({"vary": {"horizon": [64, 16]}}, r"vary\['horizon'\] must be two positive numbers, the lower one first"),
        ({"vary": {"horizon": 16}}, r"vary\['horizon'\]"),
        ({"vary": {"max_rms": [0.1, float("nan")]}}, r"vary\['max_rms'\]"),
        ({"vary": [16, 64]}, "vary must be a dictionary"),
        ({"options": {"horizon": 32}}, "both have horizon"),
        ({"reward": "max_rms"}, "vary needs a track, features and a reward of information_gain"),
        ({"env": "family"}, "vary needs a track"),
        ({"hyperparameters": PPOSettings(num_envs=LANES, features=False)}, "features False"),
        ({"hyperparameters": PPOSettings(num_envs=LANES + 1)}, f"take {2 * LANES}"),
    ],
)
def test_what_cannot_be_varied_is_refused(settings, named):
    with pytest.raises(ValueError, match=named):
        config(**settings)


def test_an_option_that_does_not_exist_is_refused_before_anything_is_written(tmp_path):
    with pytest.raises((TypeError, ValueError), match="max_rsm"):
        train(config(vary={"max_rsm": [0.01, 0.1]}, output=tmp_path / "run"))
    assert not (tmp_path / "run").exists()
