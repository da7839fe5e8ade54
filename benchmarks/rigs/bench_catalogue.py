"""The rigs: truth, what the rig file says, inputs and noises. Numbers are in the units of each rig's channels."""

import math
from dataclasses import dataclass, replace

import numpy as np

from benchmarks.rigs.dop853_simulator import SENSOR_KINDS, FloatArray

PARAMETERS = ("m", "c", "a", "b")
N_SAMPLES = 4096


@dataclass(frozen=True)
class Bench:
    """A rig in the world.

    Attributes:
        name: short, of the tables.
        description: what it is.
        truth: m, c, a and b. With y in mm and u in N, m is in N s²/mm; of a velocity or an acceleration alike.
        step: time between two recorded samples [s].
        units: of input and output.
        limit: of the input.
        amplitude: of the input that is played.
        hold: samples for which each of its values is kept; 0 for a multisine.
        output_range: of the output.
        sensor_noise: standard deviation of each recorded output, before any filter.
        process_noise: standard deviation of the force that is held over each sample of the integration.
        shape: of the input's values: ``binary``, ``uniform``, or ``multisine`` up to ``max_frequency`` Hz.
        kind: of the output: displacement, velocity or acceleration.
        interpolation: as the rig file says, and as it is unless ``decimate`` is above 1.
        offset: of the sensor.
        decimate: samples of the integration for each recorded one; an anti-alias filter stands between.
        max_frequency: frequency of a multisine [Hz].
        quintic: stiffness of x⁵.
    """

    name: str
    description: str
    truth: tuple[float, float, float, float]
    step: float
    units: tuple[str, str]
    limit: float
    amplitude: float
    hold: int
    output_range: float
    sensor_noise: float
    process_noise: float
    shape: str = "binary"
    kind: str = "displacement"
    interpolation: str = "zero_order"
    offset: float = 0.0
    decimate: int = 1
    max_frequency: float = 0.0
    quintic: float = 0.0

    @property
    def parameters(self) -> FloatArray:
        """(5,) m, c, a, b and the quintic stiffness."""
        return np.array([*self.truth, self.quintic])

    @property
    def rest(self) -> float:
        """Displacement where it rests at the start: of two wells, the one on the right."""
        _, _, a, b = self.truth
        return math.sqrt(-a / b) if a < 0 else 0.0

    @property
    def angular_frequency(self) -> float:
        """Of small oscillations about rest [rad/s]."""
        m, _, a, _ = self.truth
        return math.sqrt((a if a > 0 else -2 * a) / m)

    @property
    def samples_per_period(self) -> float:
        """Recorded, of small oscillations."""
        return 2 * math.pi / (self.angular_frequency * self.step)

    @property
    def scale(self) -> FloatArray:
        """(2,) sizes of x and x'."""
        size = self.output_range / self.angular_frequency ** SENSOR_KINDS.index(self.kind)
        return np.array([size, size * self.angular_frequency])

    def excitation(self, rng: np.random.Generator, n_samples: int = N_SAMPLES) -> FloatArray:
        """Inputs, one for each sample of the integration."""
        count = n_samples * self.decimate
        if self.shape == "multisine":
            times = np.arange(count) * self.step / self.decimate
            lines = np.arange(1, int(self.max_frequency * count * self.step / self.decimate) + 1) / times[-1]
            phases = rng.uniform(0, 2 * np.pi, len(lines))
            # The inverse transform would be shorter, but the lines need not be those of the record.
            u = sum(np.cos(2 * np.pi * f * times + phase) for f, phase in zip(lines, phases, strict=True))
            return np.asarray(self.amplitude * u / np.abs(u).max())
        values = -(-count // self.hold) + 1
        drawn = rng.uniform(-1, 1, values) if self.shape == "uniform" else rng.choice([-1.0, 1.0], values)
        begin = int(rng.integers(self.hold))
        return np.asarray(self.amplitude * np.repeat(drawn, self.hold)[begin : begin + count])


_MEMS_MASS = 1e-8  # nN s²/µm, which is 1e-11 kg
_MEMS_STIFFNESS = _MEMS_MASS * (2 * math.pi * 60e3) ** 2

DESK_BENCH = Bench("a", "bench: 0.4 kg, 12.6 Hz, in N and mm", (4e-4, 6e-4, 2.5, 4e-2), 1e-3, ("N", "mm"), 20.0, 6.0, 20, 30.0,
          5e-3, 2e-2)  # fmt: skip
MEMS_RESONATOR = Bench("b", "MEMS resonator: 1e-11 kg, 60 kHz, Q 200, in nN and µm",
          (_MEMS_MASS, math.sqrt(_MEMS_MASS * _MEMS_STIFFNESS) / 200, _MEMS_STIFFNESS, 0.3 * _MEMS_STIFFNESS), 2e-6,
          ("nN", "µm"), 100.0, 100.0, 2, 3.0, 1e-4, 0.3,
          "uniform")  # fmt: skip
SOFTENING_SPRING = Bench("c", "softening spring", (1.0, 0.5, 400.0, -4000.0), 1e-2, ("N", "m"), 6.0, 6.0, 10, 0.3, 1e-4, 2e-2,
          "uniform")  # fmt: skip
TWO_WELLS = Bench("d", "two wells", (1.0, 0.3, -1.0, 1.0), 0.1, ("N", "m"), 0.8, 0.8, 10, 3.0, 1e-3, 2.5e-3)
_SILVERBOX_GAIN = 186_015.0
SILVERBOX_HELD = Bench("e", "the Silverbox circuit, its input held",
          (1 / _SILVERBOX_GAIN, 41.8992 / _SILVERBOX_GAIN, 184_255.0 / _SILVERBOX_GAIN, 730_155.0 / _SILVERBOX_GAIN), 2**14 / 1e7, ("V", "V"), 0.15, 0.1, 2,
          1.0, 5e-4, 3e-4)  # fmt: skip
# The parameters that its documentation reports as identified; see the page of the board's own.
ELECTRONIC_BOARD = Bench("board", "electronic-duffing, one well", (1.0461e-4, 1.4231e-4, 1.8099, 1.0077), 1e-3, ("V", "V"), 1.0,
              0.5, 12, 10.0, 5e-3, 5e-3)  # fmt: skip
ELECTRONIC_BOARD_VELOCITY = replace(ELECTRONIC_BOARD, name="board-v", description="the same, its velocity seen", kind="velocity", units=("V", "V/s"),
                  output_range=1500.0, sensor_noise=0.5)  # fmt: skip
ELECTRONIC_BOARD_TWO_WELLS = replace(ELECTRONIC_BOARD, name="wells", description="electronic-duffing, two wells",
                truth=(1.0461e-4, 1.4231e-4, -1.8099, 1.0077), amplitude=0.8)  # fmt: skip
DECIMATED_BEAM = Bench("beam", "8 Hz in V and mm, 8 kHz filtered and decimated", (8e-4, 1.6e-3, 2.0, 3e-2), 1 / 400,
             ("V", "mm"), 1.95, 1.8, 0, 40.0, 2e-2, 2e-2, "multisine", interpolation="spline", decimate=20,
             max_frequency=12.0)  # fmt: skip
SHAKER_ACCELEROMETER = Bench("accel", "0.5 kg at 15 Hz, seen by an accelerometer", (0.5, 1.5, 4500.0, 3e7), 1e-3, ("N", "m/s²"), 20.0,
               5.0, 20, 400.0, 1e-1, 2e-2, kind="acceleration")  # fmt: skip

DESK_BENCH_OFFSET = replace(DESK_BENCH, name="a+", description="a, the sensor off by 0.3 mm", offset=0.3)

BENCHES = {
    bench.name: bench
    for bench in (
        DESK_BENCH,
        DESK_BENCH_OFFSET,
        MEMS_RESONATOR,
        SOFTENING_SPRING,
        TWO_WELLS,
        SILVERBOX_HELD,
        ELECTRONIC_BOARD,
        ELECTRONIC_BOARD_VELOCITY,
        ELECTRONIC_BOARD_TWO_WELLS,
        DECIMATED_BEAM,
        SHAKER_ACCELEROMETER,
    )
}
