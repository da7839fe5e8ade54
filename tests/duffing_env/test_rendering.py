"""Rendering: the contents of a frame, its cost, and that it needs no display."""

import copy
import os
import pickle
import subprocess
import sys
import timeit
import tracemalloc
import warnings

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.error import DependencyNotInstalled
from gymnasium.utils.env_checker import check_env
from scipy import stats

from duffing_env import TRACKS
from duffing_env.rendering import episode_renderer
from duffing_env.rendering.episode_renderer import HEIGHT, MAX_SAMPLES_SHOWN, WIDTH, EpisodeRenderer
from duffing_env.tracks.model_env import ModelExperiment
from estimator.engine.storage_layout import belief_rows
from estimator.models.named_parameters import Parameters
from estimator.priors import silverbox_prior
from estimator.rigs.silverbox_constants import SILVERBOX_SAMPLING_STEP, SILVERBOX_TWIN

PRIOR = silverbox_prior()


def changed(**entries):
    """The prior with other numbers in its record."""
    record = PRIOR.record.copy()
    for name, value in entries.items():
        record[belief_rows(PRIOR.model).index(name)] = value
    return PRIOR.with_records([record])[0]  # without the checks, as in an environment


def started(horizon=100, truth=SILVERBOX_TWIN, belief=PRIOR):
    screen = EpisodeRenderer("rgb_array", {"u": 0.15}, 0.6, 30)
    screen.start(truth, belief, horizon)
    return screen


def with_samples(count, **options):
    screen = started(**options)
    for k in range(count):
        screen.add_sample(
            0.1 * np.sin(k), 0.3 * np.cos(k), changed(eta=0.4 + 0.01 * np.sin(k), P_eta_eta=1e-3 / (k + 1))
        )
    return screen


def panel_of(screen, row):
    """One of the four panels of parameters, as last drawn."""
    screen.frame()
    return screen._figure_cache._parameters[row]


@pytest.fixture
def no_display(monkeypatch):
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")


def test_imports_are_light_and_frames_need_no_display_and_no_pyplot():
    script = """
import sys, gymnasium, duffing_env, duffing_env.env, duffing_env.rendering.episode_renderer
heavy = {"matplotlib", "torch", "pygame"} & set(sys.modules)
assert not heavy, heavy
env = gymnasium.make("duffing_env/Amplitude-v0", render_mode="rgb_array")
env.reset(seed=0)
env.step(env.action_space.sample())
assert env.render().std() > 0
assert "matplotlib.pyplot" not in sys.modules
"""
    clean = {name: value for name, value in os.environ.items() if name not in ("DISPLAY", "MPLBACKEND")}
    ran = subprocess.run([sys.executable, "-c", script], env=clean, capture_output=True, text=True)
    assert ran.returncode == 0, ran.stderr


def test_frames_are_rgb_and_change_with_the_samples():
    env = gym.make("duffing_env/Amplitude-v0", render_mode="rgb_array")
    env.reset(seed=3)
    frames = [env.render()]
    for action in (0.5, -0.5, 1.0):
        env.step(np.array([action], dtype=np.float32))
        frames.append(env.render())
    env.close()
    for frame in frames:
        assert frame.shape == (HEIGHT, WIDTH, 3)
        assert frame.dtype == np.uint8
        assert frame.flags.c_contiguous
    assert len({frame.tobytes() for frame in frames}) == len(frames)


def test_gymnasiums_checker_is_content_and_silent(no_display):
    env = gym.make("duffing_env/Amplitude-v0", render_mode="rgb_array")
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        check_env(env.unwrapped)
    assert [str(warning.message) for warning in caught] == []


def test_curves_and_numbers_are_those_of_the_episode():
    env = gym.make("duffing_env/Amplitude-v0", render_mode="rgb_array").unwrapped
    env.reset(seed=5)
    inputs, gained, moments = [], 0.0, [env.belief.physical()]
    for action in np.sin(np.arange(20), dtype=np.float32):
        _, _, _, _, info = env.step(action[np.newaxis])
        inputs.append(0.15 * float(action))
        gained += info["information_gain"]
        moments.append(env.belief.physical())
    screen = env._renderer
    half = stats.norm.ppf(0.95) * np.sqrt([np.diag(cov) for _, cov in moments])
    mean = np.array([mean for mean, _ in moments])
    truth = np.array([env.truth.m, env.truth.c, env.truth.a, env.truth.b])
    for row, unit in enumerate((1e-6, 1e-4, 1, 1)):
        panel = panel_of(screen, row)
        times, percent = panel.mean.get_data()
        np.testing.assert_allclose(times, np.arange(21) * SILVERBOX_SAMPLING_STEP * 1e3)
        np.testing.assert_allclose(percent, 100 * (mean[:, row] / truth[row] - 1), atol=1e-9)
        band = panel.band.get_paths()[0].vertices
        upper = np.clip(100 * ((mean + half)[:, row] / truth[row] - 1), -150, 150)
        assert band[:, 1].max() == pytest.approx(upper.max(), rel=1e-4)
        shown = f"{mean[-1, row] / unit:.3f} ± {half[-1, row] / unit:.3f}"
        assert panel._estimate.get_text() == shown
        assert panel._true_value.get_text() == f"true {truth[row] / unit:.3f}"
    np.testing.assert_allclose(screen._figure_cache._signals[0].animated_artists[0].get_ydata()[1:], inputs, rtol=1e-6)
    assert screen._figure_cache._status.get_text() == f"sample 20 of 256, {gained:.1f} nats gained"


@pytest.mark.parametrize(
    ("track", "title", "labels", "signals"),
    [
        ("Pendulum-v1", "pendulum map", ["p1 [s⁻²]", "p2 [s⁻¹]", "p3 [rad/s²]"], ["input u", "output y [rad]"]),
        (
            "WienerHammerstein-v0",
            "wiener hammerstein",
            ["stiffness", "damping", "cubic [V⁻²]", "decay"],
            ["input u [V]", "output y [V]"],
        ),
    ],
)
def test_other_models_are_drawn_with_their_own_names_units_and_truth(track, title, labels, signals):
    experiment = ModelExperiment(**TRACKS[f"duffing_env/{track}"]["kwargs"])
    screen = EpisodeRenderer("rgb_array", {"u": experiment.max_input}, experiment.max_output, 30, experiment.scales)
    truth = Parameters({name: 1.1 * value + 0.01 for name, value in experiment.nominal_parameters.items()})
    screen.start(truth, experiment.prior_belief, 256)
    screen.add_sample(0.1, 0.2, experiment.prior_belief)
    assert screen.frame().shape == (HEIGHT, WIDTH, 3)
    picture, names = screen._figure_cache, episode_renderer.shown_parameters(experiment.model)
    heading = picture._figure.texts[0]
    assert heading.get_text() == title
    picture._status.set_text("sample 1024 of 1024, 123.4 nats gained")
    spaces = [text.get_window_extent(picture._canvas.get_renderer()) for text in (heading, picture._status)]
    assert spaces[0].x1 + 4 < spaces[1].x0
    assert [panel.axes.get_title("left") for panel in picture._parameters] == labels
    assert [panel.axes.get_title("left") for panel in picture._signals] == signals
    for panel, name in zip(picture._parameters, names, strict=True):
        assert panel._true_value.get_text() == f"true {truth[name]:.3f}".replace("-", "−")
        assert np.isfinite(panel.mean.get_ydata()).all()


def test_moments_are_those_of_each_belief():
    beliefs = [
        changed(eta=0.3, theta1=1.5),
        PRIOR,
        changed(eta=0.0),
        changed(theta2=np.nan),
        changed(P_theta1_theta1=np.inf),
    ]
    means, stds = episode_renderer._physical_moments(beliefs)
    for k, belief in enumerate(beliefs[:2]):
        mean, cov = belief.physical()
        np.testing.assert_allclose(means[:, k], mean)
        np.testing.assert_allclose(stds[:, k], np.sqrt(np.diag(cov)))
    assert np.isnan(means[:, 2:]).all()
    assert np.isnan(stds[:, 2:]).all()


@pytest.mark.parametrize("value", [np.nan, np.inf, -1e300, 1e300])
def test_numbers_without_bounds_are_drawn_within_the_axes(value):
    screen = started()
    screen.add_sample(0.1, value, changed(theta1=value, P_theta2_theta2=abs(value)))
    screen.add_sample(value, 0.1, changed(theta2=value))
    screen.add_sample(0.1, 0.1, changed(eta=1e-5))
    panel = panel_of(screen, 3)
    drawn = panel.mean.get_ydata()
    assert np.nanmax(np.abs(drawn)) <= 150
    assert panel._estimate.get_text() == "not known yet"
    screen.add_sample(0.1, 0.1, PRIOR)
    assert "±" in panel_of(screen, 3)._estimate.get_text()


def test_an_episode_without_a_usable_belief_is_drawn():
    screen = started(belief=changed(eta=0.0))
    assert [panel_of(screen, row)._estimate.get_text() for row in range(4)] == ["not known yet"] * 4


def test_long_episodes_scroll():
    screen = with_samples(MAX_SAMPLES_SHOWN + 44, horizon=1000)
    times = panel_of(screen, 0).mean.get_xdata()
    np.testing.assert_allclose(times[[0, -1]], np.array([44, MAX_SAMPLES_SHOWN + 44]) * SILVERBOX_SAMPLING_STEP * 1e3)
    low, high = screen._figure_cache._panels[0].axes.get_xlim()
    assert low < times[0] < times[-1] < high
    assert high - low < 1.05 * (times[-1] - times[0])


def test_time_axes_reach_over_short_episodes():
    screen = with_samples(1, horizon=40)
    screen.frame()
    assert screen._figure_cache._panels[0].axes.get_xlim()[1] == pytest.approx(
        40 * SILVERBOX_SAMPLING_STEP * 1e3, rel=0.02
    )


def test_frames_hold_nothing_of_earlier_frames_and_episodes():
    screen = with_samples(60)
    first = screen.frame()
    kept = first.copy()
    screen.start(SILVERBOX_TWIN, PRIOR, 100)
    np.testing.assert_array_equal(screen.frame(), started().frame())
    np.testing.assert_array_equal(first, kept)


def test_frames_reuse_the_figure_and_keep_no_memory():
    screen = with_samples(30)
    screen.frame()
    figure = screen._figure_cache._figure
    artists = len(figure.findobj())
    screen.frame()
    tracemalloc.start()
    for _ in range(4):
        screen.frame()
    grown, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert screen._figure_cache._figure is figure
    assert len(figure.findobj()) == artists
    assert grown < HEIGHT * WIDTH * 3  # one frame


def test_taking_note_of_a_sample_draws_nothing():
    screen = started()
    screen.add_sample(0.1, 0.2, PRIOR)
    assert screen._figure_cache is None


@pytest.mark.slow  # a time, which a busy machine makes longer
def test_taking_note_of_a_sample_is_cheap():
    screen = started()
    fastest = min(timeit.repeat(lambda: screen.add_sample(0.1, 0.2, PRIOR), number=100, repeat=5)) / 100
    assert fastest < 50e-6


def test_copies_and_pickles_draw_the_same():
    screen = with_samples(10)
    frame = screen.frame()
    for copied in (copy.deepcopy(screen), pickle.loads(pickle.dumps(screen))):
        np.testing.assert_array_equal(copied.frame(), frame)
        copied.add_sample(0.1, 0.2, PRIOR)
        assert not np.array_equal(copied.frame(), frame)
    np.testing.assert_array_equal(screen.frame(), frame)


def test_window_shows_the_frames_at_the_rate_and_closes(no_display):
    pygame = pytest.importorskip("pygame")

    def seen():
        return pygame.surfarray.array3d(pygame.display.get_surface()).swapaxes(0, 1)

    screen = EpisodeRenderer("human", {"u": 0.15}, 0.6, fps=20)
    screen.start(SILVERBOX_TWIN, PRIOR, 100)
    empty = seen()
    np.testing.assert_array_equal(empty, started().frame())
    began = timeit.default_timer()
    for k in range(4):
        screen.add_sample(0.1, 0.05 * k, PRIOR)
    assert timeit.default_timer() - began > 3 / 20
    np.testing.assert_array_equal(seen(), screen.frame())
    assert not np.array_equal(seen(), empty)
    before = seen()
    copied = copy.deepcopy(screen)
    copied.add_sample(0.1, 0.3, PRIOR)
    np.testing.assert_array_equal(seen(), before)
    screen.close()
    assert not pygame.display.get_init()
    screen.close()


def test_environment_in_mode_human_returns_no_array(no_display):
    pygame = pytest.importorskip("pygame")
    env = gym.make("duffing_env/Amplitude-v0", render_mode="human")
    env.reset(seed=0)
    env.step(np.zeros(1, dtype=np.float32))
    assert env.render() is None
    assert pygame.display.get_surface().get_size() == (WIDTH, HEIGHT)
    env.close()
    assert not pygame.display.get_init()


def test_mode_human_without_pygame_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "pygame", None)
    with pytest.raises(DependencyNotInstalled, match=r'pip install "duffing-env\[human\]"'):
        EpisodeRenderer("human", {"u": 0.15}, 0.6, 30)
