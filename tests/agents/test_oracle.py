"""The oracle: its store, and the D-efficiency against it; and the oracles that are in the package."""

import shutil

import numpy as np
import pytest
from tables import table

from agents.evaluation import oracle as module_of_oracle
from agents.evaluation.oracle import Oracle, TrackSystems, quantise

SHORT, POWER, CONTINUOUS = "duffing_env/Short-v0", "duffing_env/Power-v0", "duffing_env/Amplitude-v1"
STORED = [f"duffing_env/{name}-v{version}" for name in ("Amplitude", "Short", "Power", "Output") for version in (0, 1)]


def answers(systems, inputs):
    """Outputs (n, T) without noise, from rest."""
    y = np.empty_like(inputs)
    for theta, u, row in zip(systems.theta, inputs, y, strict=True):
        x = last = 0.0
        for t in range(len(u)):
            x, last = theta @ np.array([x, x**3, last, u[t]]), x
            row[t] = x
    return y


def gains(systems, values):
    return values - 0.5 * np.linalg.slogdet(systems.precision)[1]


def test_an_oracle_of_another_task_is_refused(tmp_path, monkeypatch):
    ours, others = TrackSystems.of(POWER, 2), TrackSystems.of("duffing_env/Amplitude-v0", 2).path
    monkeypatch.setattr(module_of_oracle, "ORACLE_FOLDER", tmp_path)
    shutil.copy(others, ours.path)
    with pytest.raises(ValueError, match=r"oracle must be for the systems at hand, but .*npz is not; make it anew"):
        Oracle.of(ours)


def test_systems_of_another_branch_are_others_with_an_oracle_of_their_own():
    tested, others = (
        TrackSystems.of(SHORT, 64),
        [TrackSystems.of(SHORT, 64, {"branch": b}) for b in ("train", "validation")],
    )
    assert tested.description["branch"] == "test"
    for other in others:
        assert not np.isin(other.theta, tested.theta).any()
        assert other.path != tested.path


def test_rows_do_not_depend_on_their_number():
    few, many = TrackSystems.of(SHORT, 2), TrackSystems.of(SHORT, 5)
    np.testing.assert_array_equal(few.theta, many.theta[:2])
    assert few.description == many.description
    assert few.path == many.path


def test_efficiency_is_one_for_the_oracle_itself_and_counts_until_the_end():
    systems = TrackSystems.of(SHORT, 3)
    oracle = Oracle.of(systems)
    outputs = answers(systems, oracle.inputs)
    best, least = oracle.efficiency(oracle.inputs, outputs)
    np.testing.assert_allclose(best, 1.0, rtol=1e-9)
    np.testing.assert_allclose(least, np.exp((oracle.values - oracle.bounds) / 2), rtol=1e-9)
    ended, seen = oracle.inputs.copy(), outputs.copy()
    ended[0, 20:] = seen[0, 20:] = np.nan
    efficiency, _ = oracle.efficiency(ended, seen)
    assert efficiency[0] < 0.5
    np.testing.assert_allclose(efficiency[1:], 1.0, rtol=1e-9)
    with pytest.raises(ValueError, match="n <= 3"):
        oracle.efficiency(np.zeros((4, 48)), np.zeros((4, 48)))


def test_what_is_stored_is_never_larger_and_stays():
    scaled = np.random.default_rng(0).uniform(-1, 1, 1000)
    stored = quantise(scaled)
    assert np.all(np.abs(stored) <= np.abs(scaled) * (1 + 1e-8))
    np.testing.assert_allclose(stored, scaled, atol=1 / 32767)
    np.testing.assert_array_equal(quantise(0.15 * stored / 0.15), stored)


@table("track", STORED)
def test_stored_oracles_keep_the_limits_of_their_tracks(track):
    oracle = Oracle.of(TrackSystems.of(track, 256))
    assert len(oracle.values) >= 16
    limits = oracle.systems.limits
    assert np.abs(oracle.inputs).max() <= limits.amplitude
    assert oracle.systems.criterion_and_peak(oracle.inputs)[1].max() <= limits.output
    assert np.all((oracle.inputs**2).sum(axis=1) <= limits.energy * (1 + 1e-9))
    # On Eq. (1) each system has noises of its own, over a decade, and the noisiest tell less.
    floor = 10.0 if track.endswith("v1") else 15.0 if track == POWER else 18.0
    assert gains(oracle.systems, oracle.values).min() > floor


def test_tracks_without_an_oracle_say_so():
    with pytest.raises(ValueError, match="plant without jump and slew limit"):
        TrackSystems.of("duffing_env/Drift-v0", 1)
    with pytest.raises(FileNotFoundError, match="no oracle is stored"):
        Oracle.of(TrackSystems.of(CONTINUOUS, 1, {"horizon": 31}))
    with pytest.raises(ValueError, match="inputs must have shape"):
        TrackSystems.of(SHORT, 1).criterion_and_peak(np.zeros((2, 48)))
