"""Excitations and policies with feedback: spectra, limits, budgets, seeds, brakes, and the export."""

from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import pytest
from tables import table

from agents import make_policy
from agents.commands import main
from agents.policies.excitations import EXCITATIONS, PRBS_LEVELS, linear_resonance
from agents.policies.feedback import BRAKE_FRACTION, FEEDBACK
from agents.policies.signal_export import draw_signal, export_signal
from agents.policies.signals import InputLimits, SignalPolicy
from duffing_env.experiment_config import SimulatedExperiment
from duffing_env.storage.kernel_spec import observation_bounds
from estimator.models.difference_equation import difference
from estimator.models.named_parameters import Parameters
from estimator.priors import silverbox_prior
from estimator.rigs.physical_parameters import coefficients_of
from estimator.rigs.silverbox_constants import SILVERBOX_SAMPLING_STEP, SILVERBOX_TWIN

AMPLITUDE, POWER = "duffing_env/Amplitude-v0", "duffing_env/Power-v0"
RECORDED = ("silverbox-multisine", "silverbox-arrow")
DRAWN = [name for name in EXCITATIONS if name not in RECORDED]
MAX_RMS = 0.0222


def draws(name, count=300, samples=256, max_input=0.15):
    rng = np.random.default_rng(11)
    draw = EXCITATIONS[name](max_input)
    return np.array([draw(rng, samples) for _ in range(count)])


def power(name, low, high, samples=256):
    """The share of the power between two frequencies [Hz], over many draws."""
    density = (np.abs(np.fft.rfft(draws(name, samples=samples))) ** 2).mean(axis=0)
    frequency = np.fft.rfftfreq(samples, SILVERBOX_SAMPLING_STEP)
    return density[(frequency >= low) & (frequency <= high)].sum() / density.sum()


@table("name", DRAWN)
def test_draws_reach_the_limit_and_keep_it(name):
    u = np.abs(draws(name, max_input=0.2))
    assert 0.19 < u.max() <= 0.2 * (1 + 1e-12)


@table("name", ["multisine", "schroeder"])
@table("samples", [48, 255, 256])
def test_multisines_have_equal_power_on_the_lines_of_the_band_and_none_elsewhere(name, samples):
    density = np.abs(np.fft.rfft(draws(name, 5, samples))) ** 2
    frequency = np.fft.rfftfreq(samples, SILVERBOX_SAMPLING_STEP)
    inside = (frequency >= 10) & (frequency <= 150)
    assert inside.sum() >= 10
    np.testing.assert_allclose(
        density[:, inside], density[:, inside].max(axis=1, keepdims=True) * np.ones(inside.sum())
    )
    assert density[:, ~inside].max() < 1e-20 * density.max()


def test_multisines_peak_at_the_limit_and_schroeder_phases_have_the_smaller_crest_factor():
    crest = {}
    for name in ("multisine", "schroeder"):
        u = draws(name)
        np.testing.assert_allclose(np.abs(u).max(axis=1), 0.15)
        crest[name] = (0.15 / np.sqrt((u**2).mean(axis=1))).mean()
    assert crest["schroeder"] < 1.9
    assert 2.5 < crest["multisine"] < 3.5


@table(("name", "slope"), [("chirp-linear", 0.0), ("chirp-log", -1.0)])
def test_chirps_fill_the_band(name, slope):
    assert power(name, 8, 155) > 0.97
    low, high = power(name, 25, 50), power(name, 50, 100)
    # Density f^slope: the power of an octave grows as 2^(1 + slope).
    assert high / low == pytest.approx(2 ** (1 + slope), rel=0.1)
    rising = draws(name, 1)[0]
    crossings = np.flatnonzero(np.diff(np.sign(rising)))
    assert np.diff(crossings)[:2].min() > 2 * np.diff(crossings)[-5:].max()


@table("hold", [2, 4, 8])
def test_held_prbs_has_the_spectrum_of_its_hold(hold):
    density = (np.abs(np.fft.rfft(draws(f"prbs-{hold}", 4000))) ** 2).mean(axis=0)
    # The holds begin at the first sample, so that the nulls are exact where 256 is a multiple of the hold.
    nulls = 256 // hold * np.arange(1, hold // 2 + 1)
    assert density[nulls].max() < 1e-20 * density.max()
    cycles = np.arange(1, 256 // hold) / 256
    expected = 0.15**2 * 256 * np.sin(np.pi * cycles * hold) ** 2 / (hold * np.sin(np.pi * cycles) ** 2)
    np.testing.assert_allclose(density[1 : 256 // hold], expected, rtol=0.12)


def test_white_excitations_are_white():
    for name in ("gaussian", "prbs", "uniform"):
        assert power(name, 0, 152.6) == pytest.approx(0.5, abs=0.02)


def test_gaussian_is_a_third_of_the_limit():
    assert draws("gaussian").std() == pytest.approx(0.05, rel=0.02)


def test_levels_are_five_and_even():
    u = draws("multilevel-prbs")
    values, counts = np.unique(u[:, ::4], return_counts=True)
    np.testing.assert_allclose(values, 0.15 * np.array(PRBS_LEVELS))
    np.testing.assert_allclose(counts / counts.sum(), 0.2, atol=0.02)
    np.testing.assert_array_equal(u[:, ::4], u[:, 3::4])


def test_square_is_a_square_wave_at_the_resonance_of_the_twin():
    u = draws("square", 20, 2048)
    assert set(np.unique(u)) == {-0.15, 0.15}
    frequency = np.fft.rfftfreq(2048, SILVERBOX_SAMPLING_STEP)
    peaks = frequency[np.abs(np.fft.rfft(u)).argmax(axis=1)]
    np.testing.assert_allclose(peaks, np.sqrt(SILVERBOX_TWIN.a / SILVERBOX_TWIN.m) / (2 * np.pi), atol=0.5)
    assert len(np.unique(u[:, :9], axis=0)) > 3  # the phase is drawn


def test_resonance_is_where_a_free_oscillation_crosses_zero():
    for m, c, a in ((0.7, 1.0, 1.3), (1.3, 0.7, 0.7)):
        twin = SILVERBOX_TWIN
        theta1, _, theta3, _ = coefficients_of(
            difference(), Parameters(m=m * twin.m, c=c * twin.c, a=a * twin.a, b=1.0)
        )
        x = [0.0, 1.0]
        while len(x) < 600:
            x.append(theta1 * x[-1] + theta3 * x[-2])
        crossings = np.flatnonzero(np.diff(np.signbit(x[1:])))
        halves = crossings.size - 1
        measured = halves / (2 * SILVERBOX_SAMPLING_STEP * (crossings[-1] - crossings[0]))
        found = linear_resonance(theta1, theta3)
        assert found == pytest.approx(measured, rel=2 / (crossings[-1] - crossings[0]))
    assert linear_resonance(np.float64(1.0), np.float64(0.1)) == 10.0  # describes no oscillator


@table("name", EXCITATIONS)
def test_a_budget_scales_the_whole_signal_down_to_it(name):
    free, fitted = (draw_signal(name, samples=256, max_rms=rms, seed=4) for rms in (None, MAX_RMS))
    rms = np.sqrt(np.mean(free**2))
    np.testing.assert_allclose(fitted, min(1.0, MAX_RMS / rms) * free, rtol=2e-6)
    assert np.sqrt(np.mean(fitted**2)) <= MAX_RMS
    if name not in RECORDED:
        assert rms > MAX_RMS


def test_limits_leave_what_fits_and_silence_alone():
    limits = InputLimits(0.1, 0.05)
    np.testing.assert_array_equal(limits.to_actions(np.zeros(5)), 0.0)
    np.testing.assert_allclose(limits.to_actions(np.array([0.04, -0.04])), [0.4, -0.4])
    np.testing.assert_allclose(
        limits.to_actions(np.array([0.3, 0.0, 0.0, 0.0])), [1.0, 0.0, 0.0, 0.0], rtol=2e-6
    )  # clipped first
    with pytest.raises(ValueError, match=r"max_rms must be positive and finite, in volts, .* but it is 0"):
        InputLimits(0.1, 0.0)
    with pytest.raises(ValueError, match=r"max_input must be positive .* it is nan"):
        SignalPolicy("prbs", EXCITATIONS["prbs"](1.0), max_input=np.nan)


def roll_out(name, track, systems, seed=21, **options):
    """Inputs asked for (T, systems) and observations (T + 1, systems, 22); the number of episodes ended by a limit."""
    envs = gym.make_vec(track, num_envs=systems, vectorization_mode="vector_entry_point", **options)
    policy = make_policy(name, envs, seed=seed)
    observations, _ = envs.reset(seed=seed)
    seen, asked, ended = [observations], [], 0
    state, starts = None, np.ones(systems, dtype=bool)
    for _ in range(envs.horizon):
        actions, state = policy.predict(observations, state, starts, deterministic=True)
        observations, _, terminated, truncated, _ = envs.step(actions)
        starts = terminated | truncated
        ended += terminated.sum()
        asked.append(actions[:, 0])
        seen.append(observations)
    return np.array(asked), np.array(seen), ended


@table("name", [*DRAWN, *FEEDBACK])
def test_the_environment_cuts_nothing_of_what_a_budget_was_fitted_to(name):
    asked, seen, _ = roll_out(name, POWER, 8)
    np.testing.assert_allclose(seen[1:, :, 18], asked, atol=1e-6)
    assert seen[-1, :, 21].max() < 1e-4  # nor is any of it left


@table("name", FEEDBACK)
@table("options", [{}, {"max_output": 0.3}])
def test_feedback_ends_no_episode_and_uses_the_room(name, options):
    asked, seen, ended = roll_out(name, AMPLITUDE, 64, **options)
    assert ended == 0
    assert set(np.unique(np.abs(asked))) == {1.0}
    peaks = np.abs(seen[:, :, 16]).max(axis=0)
    assert np.median(peaks) > 0.6


def observation(**entries):
    return np.array([entries.get(name, 0.0) for name in observation_bounds(difference())], dtype=np.float32)


def test_velocity_sign_pumps_with_the_velocity_and_brakes_beyond_the_amplitude():
    policy = make_policy("velocity-sign")
    assert policy.predict(observation())[0] == 1.0
    assert policy.predict(observation(state_x1=0.1, state_x2=0.05))[0] == 1.0
    assert policy.predict(observation(state_x1=0.1, state_x2=0.15))[0] == -1.0
    turning = observation(state_x1=BRAKE_FRACTION + 0.05, state_x2=BRAKE_FRACTION)
    assert policy.predict(turning)[0] == -1.0
    swinging = observation(state_x1=0.0, state_x2=-0.6)  # through the middle, too fast
    assert policy.predict(swinging)[0] == -1.0


def test_amplitude_is_that_of_a_sampled_sine():
    policy = make_policy("velocity-sign")
    frequency = policy.frequency(observation()[np.newaxis])
    for phase in np.linspace(0, 6, 7):
        x0, x1 = 0.3 * np.sin(phase - 2 * np.pi * frequency[0] * SILVERBOX_SAMPLING_STEP * np.arange(2))
        row = observation(state_x1=x0, state_x2=x1)[np.newaxis].astype(np.float64)
        assert policy.amplitude(row) == pytest.approx(0.3, rel=1e-4)


@table("spread", [0.3, 0.1])
def test_square_believed_has_the_frequency_of_the_posterior_mean(spread):
    env = SimpleNamespace(unwrapped=SimpleNamespace(max_input=0.15, experiment=SimulatedExperiment(spread=spread)))
    policy = make_policy("square-believed", env)
    prior = silverbox_prior(spread=spread)
    stds = np.sqrt(np.diag(prior.coefficients_cov))
    twin = SILVERBOX_TWIN
    believed = coefficients_of(difference(), Parameters(m=0.95 * twin.m, c=twin.c, a=1.05 * twin.a, b=twin.b))
    mean_t1 = (believed[0] - prior.coefficients_mean[0]) / stds[0]
    mean_t3 = (believed[2] - prior.coefficients_mean[2]) / stds[2]
    row = observation(mean_theta1=mean_t1, mean_theta3=mean_t3)
    natural = np.sqrt(1.05 * twin.a / (0.95 * twin.m)) / (2 * np.pi)
    state, wave = None, []
    for _ in range(400):
        action, state = policy.predict(row, state)
        wave.append(action[0])
    assert wave[0] == 1.0
    rises = np.flatnonzero(np.diff(wave) > 0)
    measured = (rises.size - 1) / (SILVERBOX_SAMPLING_STEP * (rises[-1] - rises[0]))
    assert measured == pytest.approx(natural, rel=0.01)


@table("name", FEEDBACK)
def test_feedback_pumps_equation_1_too(name):
    asked, seen, ended = roll_out(name, "duffing_env/Amplitude-v1", 16, horizon=128)
    assert ended == 0
    assert set(np.unique(np.abs(asked))) == {1.0}
    # The first state of its observation is the displacement too.
    assert np.median(np.abs(seen[:, :, 16]).max(axis=0)) > 0.5


def test_resonance_and_amplitude_are_read_off_equation_1():
    env = gym.make("duffing_env/Amplitude-v1").unwrapped
    policy, model = make_policy("square-believed", env), env.experiment.model
    prior = env.experiment.prior_belief.coefficients_mean
    row = np.zeros((1, len(observation_bounds(model))))
    expected = np.sqrt(prior[0] - prior[2] ** 2 / 4) / (2 * np.pi * SILVERBOX_SAMPLING_STEP)  # of m, c and a
    assert policy.frequency(row)[0] == pytest.approx(expected, rel=1e-9)
    omega = 2 * np.pi * SILVERBOX_SAMPLING_STEP * expected
    for phase in np.linspace(0, 6, 7):
        row[0, list(observation_bounds(model)).index("state_x")] = 0.3 * np.sin(phase)
        row[0, list(observation_bounds(model)).index("state_v")] = 0.3 * omega * np.cos(phase)
        assert policy.amplitude(row)[0] == pytest.approx(0.3, rel=1e-9)


@table("name", FEEDBACK)
def test_feedback_on_a_batch_is_that_on_each_row(name):
    _, seen, _ = roll_out(name, AMPLITUDE, 3)
    policy = make_policy(name)
    starts = np.zeros((60, 3), dtype=bool)
    starts[20, 1] = True
    state, alone = None, [None] * 3
    for rows, start in zip(seen[:60], starts, strict=True):
        actions, state = policy.predict(rows, state, start)
        for i in range(3):
            action, alone[i] = policy.predict(rows[i], alone[i], start[i])
            assert action.shape == (1,)
            assert action.dtype == np.float32
            assert action[0] == actions[i, 0]
    fresh, _ = policy.predict(seen[0], None)
    began, _ = policy.predict(seen[0], state, np.ones(3, dtype=bool))
    np.testing.assert_array_equal(fresh, began)


@table("name", FEEDBACK)
def test_feedback_refuses_what_is_no_observation(name):
    policy = make_policy(name)
    with pytest.raises(ValueError, match=r"observation must have the shape \(22,\)"):
        policy.predict(np.zeros((4, 7)))


def test_square_believed_refuses_another_batch():
    policy = make_policy("square-believed")
    with pytest.raises(ValueError, match="state must be for as many environments as observation, 4, but is for 3"):
        policy.predict(np.zeros((4, 22)), np.zeros(3))


@table("name", EXCITATIONS)
def test_exported_signal_is_what_the_policy_plays_first(name):
    env = SimpleNamespace(unwrapped=SimpleNamespace(max_input=0.1, horizon=64))
    policy, state, played = make_policy(name, env, seed=5), None, []
    for _ in range(64):
        actions, state = policy.predict(np.zeros((2, 22)), state)
        played.append(0.1 * actions[0, 0].astype(np.float64))
    volts = draw_signal(name, samples=64, max_input=0.1, seed=5)
    np.testing.assert_allclose(played, volts, rtol=1e-6, atol=1e-9)
    np.testing.assert_array_equal(draw_signal(name, samples=64, max_input=0.1, seed=5), volts)
    if name not in ("square", *RECORDED):
        assert not np.array_equal(draw_signal(name, samples=64, max_input=0.1, seed=6), volts)


def test_export_round_trip(tmp_path):
    path = tmp_path / "folder" / "signal.csv"
    volts = export_signal("multisine", path, samples=100, max_input=0.12, max_rms=0.03, seed=2)
    assert path.read_text().splitlines()[0] == "t [s],u [V]"
    table = np.loadtxt(path, delimiter=",", skiprows=1)
    np.testing.assert_array_equal(table[:, 0], SILVERBOX_SAMPLING_STEP * np.arange(100))
    np.testing.assert_array_equal(table[:, 1], volts)
    assert [entry.name for entry in path.parent.iterdir()] == ["signal.csv"]


@table(
    ("name", "options", "message"),
    [
        ("multisin", {}, r"name must be one of .*did you mean 'multisine'"),
        ("velocity-sign", {}, r"must be played: use agents.make_policy"),
        ("prbs", {"samples": 0}, "samples must be a whole number from 1 to 4194304, but is 0"),
        ("prbs", {"samples": 10**12}, "samples must be a whole number from 1 to 4194304, but is 1000000000000"),
        ("prbs", {"max_input": "x"}, "max_input must be positive and finite, in volts, .* but it is 'x'"),
        ("multisine", {"samples": 4}, r"samples must be 5 or more .* but it is 4"),
        ("prbs", {"max_input": -1.0}, r"max_input must be positive and finite, in volts, .* but it is -1"),
        ("prbs", {"max_rms": np.inf}, r"max_rms must be positive and finite, in volts, .* but it is inf"),
        ("prbs", {"seed": -1}, "seed must be a whole number from 0 to .*, but is -1"),
    ],
)
def test_export_refuses_and_writes_nothing(tmp_path, name, options, message):
    with pytest.raises(ValueError, match=message):
        export_signal(name, tmp_path / "signal.csv", **options)
    assert not list(tmp_path.iterdir())


def test_export_from_the_command_line(tmp_path, capsys):
    path = tmp_path / "prbs.csv"
    main(["export", "prbs-4", "--samples", "32", "--output", str(path)])
    assert "32 samples" in " ".join(capsys.readouterr().out.split())
    np.testing.assert_array_equal(np.loadtxt(path, delimiter=",", skiprows=1)[:, 1], draw_signal("prbs-4", samples=32))
