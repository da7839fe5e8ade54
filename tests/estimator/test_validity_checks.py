"""Warnings of `identify`: each check names its fault. benchmarks/rigs measures detection and false alarms."""

import re
import sys
from dataclasses import replace

import numpy as np
import pytest
from oscillators import BENCH, SOFT, WELLS, deviations, rig_of, simulated, struck

from estimator import Channel, Rig, identify
from estimator.identification.data.record import Record
from estimator.identification.diagnostics.record_checks import _check_outliers, _check_short_impacts

GUESS = {name: tuple(sorted((0.7 * value, 1.4 * value))) for name, value in BENCH[0].items()}


@pytest.mark.parametrize(
    ("change", "name"),
    [
        (lambda u, y: (np.roll(u, -1), y), "delay"),
        (lambda u, y: (np.convolve(u, [0.5, 0.5])[: len(u)], y), "delay"),  # a mean of two is half a sample late
        (lambda u, y: (u * (1 + 0.07 * np.random.default_rng(0).standard_normal(len(u))), y), "process_noise"),
    ],
)
def test_faults_are_named(change, name):
    result = identify(rig_of(BENCH), change(*simulated(BENCH)))
    assert name in [warning.name for warning in result.warnings]


def test_a_gross_outlier_stands_first():
    u, y = simulated(BENCH, samples=1024)
    y[700], y[3] = 1e3, -80.0
    first = identify(rig_of(BENCH), (u, y)).warnings[0]
    assert first.name == "outliers"
    assert "2 outputs are outliers: sample 700 of record 0 is 1e+03 m" in first.message
    assert "and 99 % of the outputs are within 0.0" in first.message


def test_a_blow_that_rings_out_in_a_long_silence_is_no_outlier():
    k = np.arange(4000)
    y = np.exp(-k / 15) * np.cos(2 * np.pi * k / 5) + 1e-4 * np.random.default_rng(0).standard_normal(len(k))
    assert np.abs(y).max() > 20 * np.quantile(np.abs(y), 0.99)
    struck = Record("struck", np.zeros(4000), np.concatenate([y[:1000] * 1e-4, y[:3000]]))
    assert _check_outliers(Channel("m"), [struck]) == []
    struck.y[50] = 30.0
    (found,) = _check_outliers(Channel("m"), [struck])
    assert found.message.startswith("1 output is an outlier: sample 50 of struck is 30 m")
    assert _check_outliers(Channel("m/s²", kind="acceleration"), [struck]) == []


@pytest.mark.parametrize("late", [4, 12, 24, 45])
def test_a_large_delay_is_found_step_by_step(late):
    u, y = simulated(BENCH, samples=1024)
    delay = 0
    for _ in range(6):
        warnings = identify(rig_of(BENCH, delay=delay), (u[late:], y[:-late])).warnings
        messages = " ".join(one.message for one in warnings if one.name == "delay")
        delays = re.findall(r"'zero_order' with delay (\d+), by", messages)
        if not delays:
            break
        (delay,) = map(int, delays)
    assert (delay, warnings) == (late, ())


def test_an_accelerometer_that_is_sampled_after_the_input_switches():
    u, before = simulated(BENCH, kind="acceleration")
    after = before + np.diff(u, prepend=0.0) / BENCH[0]["m"]
    named = {one.name: one.message for one in identify(rig_of(BENCH, "acceleration"), (u, after)).warnings}
    assert "write an empty cell in place of y where it switches, and keep 'zero_order'" in named["interpolation"]
    after[1:][u[1:] != u[:-1]] = np.nan
    result = identify(rig_of(BENCH, "acceleration"), (u, after))
    assert result.warnings == ()
    assert np.abs(deviations(result, BENCH[0])).max() < 4.5


def test_a_channel_with_reversed_sign_and_negative_damping_are_named():
    u, y = simulated(BENCH)
    for records, guess in (((u, -y), None), ((-u, y), None), ((u, -y), GUESS)):
        result = identify(rig_of(BENCH, guess=guess), records)
        assert [warning.name for warning in result.warnings] == ["sign"]
        assert "m is negative: the polarity" in result.warnings[0].message
    fed = (SOFT[0] | {"c": -0.02}, *SOFT[1:])
    (warning,) = identify(rig_of(fed), simulated(fed)).warnings
    assert (warning.name, warning.message.split(":")[0]) == ("sign", "c is negative")


@pytest.mark.parametrize(
    ("change", "slip"),
    [
        ({"m": 1000}, "check the units of guess and columns"),  # in grams
        ({"a": 0.01}, "a: far outside"),
        ({"m": 30, "c": 30, "a": 30, "b": 30}, "if the input were about 31 times"),
        # in m, with an output in mm
        ({"m": 1e3, "c": 1e3, "a": 1e3, "b": 1e9}, "if the output were about 0.00095 times"),
    ],
)
def test_a_guess_that_leads_the_fit_astray_is_named_and_nothing_else(change, slip):
    u, y = simulated(BENCH, samples=256)
    guess = {name: tuple(change.get(name, 1) * end for end in ends) for name, ends in GUESS.items()}
    (warning,) = identify(rig_of(BENCH, guess=guess), (u, y)).warnings
    assert warning.name == "guess"
    assert re.search(r"by \d+ nats the records speak for m = 0\.(4|39\d+|40\d+) and not ", warning.message)
    assert slip in warning.message


@pytest.mark.parametrize(
    ("channel", "factor"), [("input", 4.45), ("input", 1 / 4.45), ("output", 3), ("output", 1 / 3)]
)
def test_a_wrong_scale_is_distinguished_from_a_wrong_step(channel, factor):
    u, y = simulated(BENCH, samples=1024)
    records = (u / factor, y) if channel == "input" else (u, y / factor)
    (warning,) = identify(rig_of(BENCH, guess=GUESS), records).warnings
    assert warning.name == "guess"
    factors = re.findall(rf"if the {channel} were about (\S+) times as large as recorded", warning.message)
    assert [float(one) for one in factors] == pytest.approx([factor], rel=0.1)


@pytest.mark.parametrize("kind", ["velocity", "acceleration"])
@pytest.mark.parametrize("factor", [0.5, 2.0])
def test_a_wrong_step_is_named_whatever_the_sensor_shows(kind, factor):
    u, y = simulated(BENCH, samples=1024, kind=kind)
    wrong = replace(rig_of(BENCH, kind, guess=GUESS), step=factor * BENCH[1])
    (message,) = (one.message for one in identify(wrong, (u, y)).warnings if one.name == "step")
    factors = re.findall(r"if the sampling step were about (\S+) times the rig's", message)
    assert [float(one) for one in factors] == pytest.approx([1 / factor], rel=0.15)


@pytest.mark.parametrize(("kind", "noise"), [("displacement", 0.0), ("velocity", 1e-7)])
def test_a_record_without_noise_is_judged_by_no_check(kind, noise):
    (m, c, a, b), h, (u, _) = BENCH[0].values(), BENCH[1] / 8, simulated(BENCH, samples=1024)
    rates = lambda x, force: np.array([x[1], (force - c * x[1] - a * x[0] - b * x[0] ** 3) / m])  # noqa: E731
    x, shown = np.zeros(2), []
    for force in u:
        shown.append(x[int(kind == "velocity")])
        for _ in range(8):
            k1 = rates(x, force)
            k2 = rates(x + h / 2 * k1, force)
            k3 = rates(x + h / 2 * k2, force)
            x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + rates(x + h * k3, force))
    y = np.array(shown) * (1 + noise * np.random.default_rng(0).standard_normal(len(u)))
    result = identify(rig_of(BENCH, kind), (u, y))
    assert result.warnings == ()
    assert [result.parameters[name][0] for name in "mcab"] == pytest.approx([m, c, a, b], rel=1e-5)


def test_a_correct_guess_is_not_blamed_for_a_wrong_limit():
    u, y = simulated(BENCH)
    source, sink = Channel("N", limit=0.012), Channel("m", range=1e-5)
    warnings = identify(Rig(BENCH[1], input=source, output=sink, guess=GUESS), (u, y)).warnings
    assert {"limit", "range"} <= {one.name for one in warnings}
    assert "guess" not in {one.name for one in warnings}
    assert "inputs of 6 N exceed the rig's limit of 0.012 N" in {one.message for one in warnings}


def test_a_wrong_step_and_a_parameter_that_does_nothing_are_named():
    u, y = simulated(BENCH)
    for factor in (0.5, 2):
        wrong = Rig(factor * BENCH[1], input=Channel("N"), output=Channel("m"), guess=GUESS)
        assert "step" in [warning.name for warning in identify(wrong, (u, y)).warnings]
    weak = (BENCH[0], BENCH[1], 0.05, 5e-6, 8)
    for known in (None, GUESS):
        warnings = identify(rig_of(weak, guess=known), simulated(weak)).warnings
        messages = [warning.message for warning in warnings if warning.name == "not_identified"]
        assert [message.split(":")[0] for message in messages] == ["b"]
        assert "the spring is linear to" in messages[0]


def test_a_bench_s_own_disturbance_is_no_fault_of_a_weak_input():
    weak = (BENCH[0], BENCH[1], 0.05, 5e-6, 8)
    records = simulated(weak, samples=1024, force=0.1)
    for limit, names in ((None, {"not_identified", "process_noise"}), (6.0, {"not_identified"})):
        rig = Rig(BENCH[1], input=Channel("N", limit=limit), output=Channel("m"))
        assert {warning.name for warning in identify(rig, records).warnings} == names


@pytest.mark.parametrize(("rate", "named"), [(1e3, True), (8e3, False)])
def test_blows_that_few_samples_see_are_named(rate, named):
    _, rig, record = struck((0.1, 0.9), rate, "displacement", 4e-3)
    messages = [one.message for one in identify(rig, record).warnings if one.name == "short_blows"]
    assert bool(messages) is named
    assert all("impacts of 3 samples" in message for message in messages)


def test_short_steps_that_a_converter_held_are_no_blows():
    _, rig, (u, y) = struck((0.1, 0.9), 1e3, "displacement", 4e-3)
    held = [Record("held", np.where(np.abs(u) > 0, 100.0, 0.0), y)]
    assert _check_short_impacts(replace(rig, interpolation="zero_order"), held) == []
    assert [one.name for one in _check_short_impacts(rig, held)] == ["short_blows"]


def test_a_search_that_failed_is_no_wrong_equation(monkeypatch):
    record = simulated(WELLS, 7, 1024, kind="acceleration", start=np.sqrt(2500.0 / 4e7))
    monkeypatch.setattr(sys.modules["estimator.identification.fitting.multistart_search"], "_MAX_ROUNDS", 0)
    (warning,) = identify(rig_of(WELLS, "acceleration"), record).warnings
    assert warning.name == "search_failed"
    assert "the search may have failed" in warning.message


def test_a_wrong_equation_is_no_search_that_failed():
    u, y = simulated(BENCH)
    noisy = u + 0.15 * u.std() * np.random.default_rng(0).standard_normal(len(u))
    assert [one.name for one in identify(rig_of(BENCH), (noisy, y)).warnings] == ["process_noise"]
