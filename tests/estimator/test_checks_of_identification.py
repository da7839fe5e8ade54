"""What `identify` warns of: each check names its fault. benchmarks/rigs says how often, and that good records pass."""

import numpy as np
import pytest
from oscillators import BENCH, SOFT, rig_of, simulated

from estimator import Channel, Rig, identify


@pytest.mark.parametrize(
    ("change", "name"),
    [
        (lambda u, y: (np.roll(u, -1), y), "delay"),
        (lambda u, y: (np.convolve(u, [0.5, 0.5])[: len(u)], y), "interpolation"),
        (lambda u, y: (u * (1 + 0.07 * np.random.default_rng(0).standard_normal(len(u))), y), "process_noise"),
    ],
)
def test_faults_are_named(change, name):
    result = identify(rig_of(BENCH), change(*simulated(BENCH)))
    assert name in [warning.name for warning in result.warnings]


def test_a_channel_that_is_turned_round_and_energy_that_flows_in_are_named():
    u, y = simulated(BENCH)
    for records in ((u, -y), (-u, y)):
        result = identify(rig_of(BENCH), records)
        assert [warning.name for warning in result.warnings] == ["sign"]
        assert "m is negative: the polarity" in result.warnings[0].message
    fed = (SOFT[0] | {"c": -0.02}, *SOFT[1:])
    (warning,) = identify(rig_of(fed), simulated(fed)).warnings
    assert (warning.name, warning.message.split(":")[0]) == ("sign", "c is negative")


def test_a_wrong_step_and_a_parameter_that_does_nothing_are_named():
    u, y = simulated(BENCH)
    guess = {name: tuple(sorted((0.7 * value, 1.4 * value))) for name, value in BENCH[0].items()}
    for factor in (0.5, 2):
        wrong = Rig(factor * BENCH[1], input=Channel("N"), output=Channel("m"), guess=guess)
        assert "step" in [warning.name for warning in identify(wrong, (u, y)).warnings]
    weak = (BENCH[0], BENCH[1], 0.05, 5e-6, 8)
    for known in (None, guess):
        warnings = identify(rig_of(weak, guess=known), simulated(weak)).warnings
        told = [warning.message for warning in warnings if warning.name == "not_identified"]
        assert [message.split(":")[0] for message in told] == ["b"]
        assert "the spring is linear to" in told[0]


def test_a_bench_s_own_disturbance_is_no_fault_of_a_weak_input():
    weak = (BENCH[0], BENCH[1], 0.05, 5e-6, 8)
    records = simulated(weak, force=0.1)
    for limit, names in ((None, {"not_identified", "process_noise"}), (6.0, {"not_identified"})):
        rig = Rig(BENCH[1], input=Channel("N", limit=limit), output=Channel("m"))
        assert {warning.name for warning in identify(rig, records).warnings} == names
