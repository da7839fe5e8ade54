"""The closed loop of benchmarks/rigs: its plant is the integrator of its records, sample by sample."""

import numpy as np

from benchmarks.rigs.bench_catalogue import BENCHES
from benchmarks.rigs.closed_loop import BenchPlant
from benchmarks.rigs.dop853_simulator import SENSOR_KINDS, simulate


def test_the_plant_is_the_integrator_sample_by_sample():
    for name in ("a", "board-v", "accel"):
        bench = BENCHES[name]
        inputs = bench.amplitude * np.random.default_rng(1).choice([-1.0, 1.0], 30)
        plant = BenchPlant(bench, seed=4)
        plant.reset()
        shown = [plant.step(u) for u in inputs]
        # The plant draws a disturbance and a noise for each sample, in turns.
        drawn = BenchPlant(bench, seed=4)._rng.standard_normal((30, 2))
        force = inputs + bench.process_noise * drawn[:, 0]
        start = np.array([bench.rest, 0.0])
        states, ends = simulate(np.array([*bench.truth, 0.0]), force, np.zeros(30), start, bench.step, bench.scale)
        place = SENSOR_KINDS.index(bench.kind)
        clean = (ends if place == 2 else states[:, place])[1:]
        expected = clean + bench.sensor_noise * drawn[:, 1]
        np.testing.assert_allclose(shown, expected, rtol=0, atol=1e-8 * np.abs(clean).max())
