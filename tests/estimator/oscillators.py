"""Oscillators that tests identify: their records, and their rigs."""

from dataclasses import replace

import numpy as np

from estimator import Channel, Rig
from estimator.inference.free_run import free_run
from estimator.models.duffing import DERIVATIVE_ORDER_OF_SENSOR, duffing
from estimator.rigs.physical_parameters import coefficients_of
from estimator.rigs.units import Scales

#: A bench of 0.4 kg at 1 kHz, and a softening oscillator at 200 Hz: truth, step, amplitude, sensor noise, and samples
#: that the input is held for.
BENCH = ({"m": 0.4, "c": 0.6, "a": 2500.0, "b": 4e7}, 1e-3, 6.0, 5e-6, 8)
SOFT = ({"m": 1.0, "c": 0.5, "a": 400.0, "b": -4000.0}, 5e-3, 6.0, 1e-4, 8)

#: Two wells, 8 mm off the hill between them, that the motion leaves again and again.
WELLS = ({"m": 0.4, "c": 0.6, "a": -2500.0, "b": 4e7}, 1e-3, 6.0, 2e-6, 16)


def simulated(case, seed=0, samples=2048, kind="displacement", force=3e-3, start=0.0):
    """Input and output of a record that begins at rest, with a force disturbance as a fraction of the input.

    It begins at a displacement ``start`` [m]. The plant is the engine's, without what the benchmark's own integrator is
    for.
    """
    truth, step, amplitude, noise, hold = case
    rng = np.random.default_rng(seed)
    u = amplitude * np.repeat(rng.choice([-1.0, 1.0], samples // hold), hold)
    model = duffing(offsets=True, sensor=kind)
    scales = Scales(step, amplitude, 1e-2, DERIVATIVE_ORDER_OF_SENSOR[kind])
    known = {p: truth.get(p, 0.0) for p in model.physical}
    disturbed = u / amplitude + force * rng.standard_normal(samples)
    state = [start / scales.displacement, 0.0]
    y = scales.output * free_run(model, coefficients_of(model, known, scales), disturbed, state)
    y = np.concatenate([[start], y[:-1]])
    sensor = noise if kind == "displacement" else 2e-3 * y.std()
    return u, y + sensor * rng.standard_normal(samples)


def struck(blows, rate, kind, lasting, seconds=2.0):
    """Rig and record of a bench of 0.35 kg under blows at given times, of given length [s]."""
    truth, scales = (
        {"m": 0.35, "c": 0.8, "a": 1800.0, "b": 3e7},
        Scales(1 / rate, 100.0, 1e-2, DERIVATIVE_ORDER_OF_SENSOR[kind]),
    )
    times, u = np.arange(int(seconds * rate)) / rate, np.zeros(int(seconds * rate))
    for begin in blows:
        inside = (times > begin) & (times < begin + lasting)
        u[inside] = 100.0 * np.sin(np.pi * (times[inside] - begin) / lasting) ** 2
    model = duffing(offsets=True, sensor=kind)
    known = coefficients_of(model, {p: truth.get(p, 0.0) for p in model.physical}, scales)
    y = scales.output * free_run(model, known, u / 100.0, interpolation="linear")
    rig = replace(rig_of((truth, 1 / rate), kind), interpolation="linear")
    return truth, rig, (u, y + 2e-3 * y.std() * np.random.default_rng(0).standard_normal(len(y)))


def rig_of(case, kind="displacement", **others):
    unit = {"displacement": "m", "velocity": "m/s", "acceleration": "m/s²"}[kind]
    return Rig(case[1], input=Channel("N"), output=Channel(unit, kind=kind), **others)


def deviations(result, truth):
    return np.array([(result.parameters[p][0] - truth[p]) / result.parameters[p][1] for p in truth])
