"""Catalogue of simulated benches: true parameters, rig file, input and noises, in the units of each rig's channels."""

import math
from dataclasses import dataclass, replace

import numpy as np

from benchmarks.rigs.dop853_simulator import SENSOR_KINDS, FloatArray

#: Parameters that are judged.
PARAMETERS = ("m", "c", "a", "b")

#: Samples of a record.
N_SAMPLES = 4096


@dataclass(frozen=True)
class Bench:
    """A simulated bench.

    Attributes:
        name: short name for tables.
        description: the bench in words.
        truth: true m, c, a and b. With y in mm and u in N, m is in N s²/mm; likewise with a velocity or acceleration.
        step: sampling step of the record [s].
        units: units of input and output.
        limit: limit of the input.
        amplitude: amplitude of the input.
        hold: samples for which each value of the input is held; 0 for a multisine.
        output_range: range of the output.
        sensor_noise: standard deviation of each recorded output, before any filter.
        process_noise: standard deviation of the force that is held over each sample of the integration.
        shape: input values: ``binary``, ``uniform``, or ``multisine`` up to ``max_frequency``.
        kind: kind of the output: displacement, velocity or acceleration.
        interpolation: interpolation in the rig file, and the true one unless ``decimate`` is above 1.
        offset: offset of the sensor.
        decimate: samples of the integration for each recorded one, behind an anti-alias filter.
        max_frequency: highest frequency of a multisine [Hz].
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
        """Displacement at rest at the start: of two wells, the right one."""
        _, _, a, b = self.truth
        return math.sqrt(-a / b) if a < 0 else 0.0

    @property
    def angular_frequency(self) -> float:
        """Angular frequency of small oscillations about rest [rad/s]."""
        m, _, a, _ = self.truth
        return math.sqrt((a if a > 0 else -2 * a) / m)

    @property
    def samples_per_period(self) -> float:
        """Recorded samples per period of small oscillations."""
        return 2 * math.pi / (self.angular_frequency * self.step)

    @property
    def scale(self) -> FloatArray:
        """(2,) sizes of x and x'."""
        size = self.output_range / self.angular_frequency ** SENSOR_KINDS.index(self.kind)
        return np.array([size, size * self.angular_frequency])

    def excitation(self, rng: np.random.Generator, n_samples: int = N_SAMPLES) -> FloatArray:
        """The inputs, one for each sample of the integration."""
        count = n_samples * self.decimate
        if self.shape == "multisine":
            times = np.arange(count) * self.step / self.decimate
            lines = np.arange(1, int(self.max_frequency * count * self.step / self.decimate) + 1) / times[-1]
            phases = rng.uniform(0, 2 * np.pi, len(lines))
            # An inverse Fourier transform would be shorter, but the record need not hold whole periods.
            u = sum(np.cos(2 * np.pi * f * times + phase) for f, phase in zip(lines, phases, strict=True))
            return np.asarray(self.amplitude * u / np.abs(u).max())
        values = -(-count // self.hold) + 1
        drawn = rng.uniform(-1, 1, values) if self.shape == "uniform" else rng.choice([-1.0, 1.0], values)
        begin = int(rng.integers(self.hold))
        return np.asarray(self.amplitude * np.repeat(drawn, self.hold)[begin : begin + count])


#: Mass of the MEMS resonator [nN s²/µm], which is 1e-11 kg.
_MEMS_MASS = 1e-8

#: Its stiffness [nN/µm], for 60 kHz.
_MEMS_STIFFNESS = _MEMS_MASS * (2 * math.pi * 60e3) ** 2

#: Input gain of the Silverbox, 1/m [s⁻²].
_SILVERBOX_GAIN = 186_015.0

DESK_BENCH = Bench(
    "a", "bench: 0.4 kg, 12.6 Hz, in N and mm", (4e-4, 6e-4, 2.5, 4e-2), 1e-3, ("N", "mm"), 20.0, 6.0, 20, 30.0,
    5e-3, 2e-2,
)  # fmt: skip
MEMS_RESONATOR = Bench(
    "b", "MEMS resonator: 1e-11 kg, 60 kHz, Q 200, in nN and µm",
    (_MEMS_MASS, math.sqrt(_MEMS_MASS * _MEMS_STIFFNESS) / 200, _MEMS_STIFFNESS, 0.3 * _MEMS_STIFFNESS), 2e-6,
    ("nN", "µm"), 100.0, 100.0, 2, 3.0, 1e-4, 0.3, "uniform",
)  # fmt: skip
SOFTENING_SPRING = Bench(
    "c", "softening spring", (1.0, 0.5, 400.0, -4000.0), 1e-2, ("N", "m"), 6.0, 6.0, 10, 0.3, 1e-4, 2e-2, "uniform",
)  # fmt: skip
TWO_WELLS = Bench("d", "two wells", (1.0, 0.3, -1.0, 1.0), 0.1, ("N", "m"), 0.8, 0.8, 10, 3.0, 1e-3, 2.5e-3)
SILVERBOX_HELD = Bench(
    "e", "the Silverbox circuit, its input held",
    (1 / _SILVERBOX_GAIN, 41.8992 / _SILVERBOX_GAIN, 184_255.0 / _SILVERBOX_GAIN, 730_155.0 / _SILVERBOX_GAIN),
    2**14 / 1e7, ("V", "V"), 0.15, 0.1, 2, 1.0, 5e-4, 3e-4,
)  # fmt: skip
# The identified parameters from the documentation of the board (docs/rig_electronic_duffing.md).
ELECTRONIC_BOARD = Bench(
    "board", "electronic-duffing, one well", (1.0461e-4, 1.4231e-4, 1.8099, 1.0077), 1e-3, ("V", "V"), 1.0, 0.5, 12,
    10.0, 5e-3, 5e-3,
)  # fmt: skip
ELECTRONIC_BOARD_VELOCITY = replace(
    ELECTRONIC_BOARD, name="board-v", description="the same, its velocity measured", kind="velocity",
    units=("V", "V/s"), output_range=1500.0, sensor_noise=0.5,
)  # fmt: skip
ELECTRONIC_BOARD_TWO_WELLS = replace(
    ELECTRONIC_BOARD, name="wells", description="electronic-duffing, two wells",
    truth=(1.0461e-4, 1.4231e-4, -1.8099, 1.0077), amplitude=0.8,
)  # fmt: skip
DECIMATED_BEAM = Bench(
    "beam", "8 Hz in V and mm, 8 kHz filtered and decimated", (8e-4, 1.6e-3, 2.0, 3e-2), 1 / 400, ("V", "mm"), 1.95,
    1.8, 0, 40.0, 2e-2, 2e-2, "multisine", interpolation="spline", decimate=20, max_frequency=12.0,
)  # fmt: skip
SHAKER_ACCELEROMETER = Bench(
    "accel", "0.5 kg at 15 Hz, measured by an accelerometer", (0.5, 1.5, 4500.0, 3e7), 1e-3, ("N", "m/s²"), 20.0, 5.0,
    20, 400.0, 1e-1, 2e-2, kind="acceleration",
)  # fmt: skip

DESK_BENCH_OFFSET = replace(DESK_BENCH, name="a+", description="a, the sensor off by 0.3 mm", offset=0.3)

#: Name to bench.
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
