"""The Silverbox record, its two excitation regimes, and their synthesised stand-ins.

The record (T. Wigren and J. Schoukens, "Three free data sets for development and benchmarking in
nonlinear system identification", ECC 2013) is one measurement of an electronic Duffing oscillator:
131,072 samples of input u and output y, in volts, at 1e7 / 2**14 = 610.35 Hz. It has two parts:

- the *arrow*, filtered Gaussian noise whose amplitude grows linearly: Kouw (2020) validates on it;
- the *multisine*, ten odd random-phase multisines: Kouw (2020) trains on it.

The data may not be redistributed, so `load_record` searches this machine for it. Where it is
absent, `synthesise_multisine` and `synthesise_arrow` make the same excitations from the published
description at the amplitudes of the record. They leave out the record's mean input of 6.2 mV,
which belongs to the instruments and not to the excitation, and the slope of the record's spectrum
by the generator's analogue filter (4 dB from the first to the last harmonic).
"""

import hashlib
import io
import os
import sys
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
import platformdirs
import scipy
from numpy.typing import NDArray

from estimator.rigs.silverbox_constants import SILVERBOX_SAMPLING_STEP

ENVIRONMENT_VARIABLE = "SILVERBOX_DATA"
CSV_NAME = "SNLS80mV.csv"
CSV_SHA256 = "ae62d5a91230c10f76e6dd02c8a4fac3c9d4d8a95fbf50e87cb0c4885003e0f1"
MAT_NAME = "SNLS80mV.mat"
MAT_SHA256 = "5c7413a52255af0cb4e2f93fb6903beb92b08965ba1e6ad0a6ffedfed8477ed4"
ARROW_SAMPLES = 40_100

REGIME_NAMES = ("multisine", "arrow")

#: Samples of a period of the multisine.
PERIOD_SAMPLES = 8192

#: Harmonics of the multisine, in multiples of 1 / period: 0.07 Hz to 199.9 Hz.
ODD_HARMONICS = np.arange(1, 2 * 1342, 2)

#: Samples of transient before each period.
TRANSIENT_SAMPLES = 400

#: Zeros before each realisation.
GAP_SAMPLES = 100

#: RMS of the multisine [V]: average over the record's ten steady periods, mean removed.
MULTISINE_RMS = 0.02234

#: Order of the arrow's low-pass filter.
ARROW_ORDER = 9

#: Cut-off frequency of the arrow's low-pass filter [Hz].
ARROW_CUTOFF = 200.0

#: RMS at the arrow's last sample [V]: the RMS of (u_t - mean) · 40,100 / t over the record's arrow.
#: The peak is then 0.142 ± 0.011 V (300 draws); the record's is 0.143 V, or 0.149 V with its mean.
ARROW_END_RMS = 0.039


class RecordNotFound(FileNotFoundError):
    """The Silverbox record is in none of the searched places; the message says how to get it."""


class RecordDamaged(ValueError):
    """A file in the Silverbox record's place is not the record: its SHA-256 is another."""


@dataclass(frozen=True, eq=False)
class Regime:
    """One part of the record.

    Attributes:
        name: `"arrow"` or `"multisine"`.
        u: Input in volts, shape `(samples,)`, read-only.
        y: Output in volts, shape `(samples,)`, read-only.
    """

    name: str
    u: NDArray[np.float64]
    y: NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class SilverboxRecord:
    """The whole record as measured: no offset is removed.

    Attributes:
        u: Input in volts, shape `(131072,)`, read-only.
        y: Output in volts, shape `(131072,)`, read-only.
    """

    u: NDArray[np.float64]
    y: NDArray[np.float64]

    @property
    def arrow(self) -> Regime:
        """The first 40,100 samples, of growing amplitude: the validation part of Kouw (2020)."""
        return Regime("arrow", self.u[:ARROW_SAMPLES], self.y[:ARROW_SAMPLES])

    @property
    def multisine(self) -> Regime:
        """The other 90,972 samples: the training part of Kouw (2020).

        As published, it begins with the last 400 samples of the arrow, which is longer than the
        validation part, and ends with the arrow's first 3,652 samples played again.
        """
        return Regime("multisine", self.u[ARROW_SAMPLES:], self.y[ARROW_SAMPLES:])


def load_record(path: str | Path | None = None) -> SilverboxRecord:
    """Loads the Silverbox record from this machine; a file is read once per process.

    Searched in this order; a folder is searched for `SNLS80mV.csv`, then `SNLS80mV.mat`:

    1. `path`, a file or a folder;
    2. the environment variable `SILVERBOX_DATA`, a file or a folder;
    3. this project's cache, `platformdirs.user_cache_dir("duffing-env")/silverbox`;
    4. the cache of the package `nonlinear_benchmarks`.

    A place that `path` or `SILVERBOX_DATA` names must hold the record: the search ends there. It
    also ends at a damaged file.

    Both files give the identical record: the CSV holds the values of the .mat rounded to five
    significant digits, so the values of the .mat are rounded likewise.

    Raises:
        RecordNotFound: The record is not in the named place, or in none of the places.
        RecordDamaged: The file found has a wrong SHA-256.
    """
    found = _find_record_file(path)
    if found is None:
        places = ", ".join(str(place) for place in _cache_folders())
        raise RecordNotFound(
            f"the Silverbox record is not on this machine: {ENVIRONMENT_VARIABLE} is unset, and "
            f"neither {CSV_NAME} nor {MAT_NAME} is in {places}. {_how_to_get_record()}"
        )
    return _read_record(found.resolve())


def record_available() -> bool:
    """Whether `load_record()` finds a file; a damaged one counts, so that `load_record` reports it.

    Raises:
        RecordNotFound: `SILVERBOX_DATA` is set, but the record is not there.
    """
    return _find_record_file(None) is not None


def _find_record_file(path: str | Path | None) -> Path | None:
    given_place, named_by = path, "path"
    if given_place is None:
        given_place, named_by = os.environ.get(ENVIRONMENT_VARIABLE) or None, ENVIRONMENT_VARIABLE
    if given_place is None:
        return next(filter(None, map(_record_file_in, _cache_folders())), None)
    found = _record_file_in(Path(given_place).expanduser())
    if found is None:
        raise RecordNotFound(
            f"{named_by} is {given_place}, but the Silverbox record is not there; it must be a file or a "
            f"folder that holds {CSV_NAME} or {MAT_NAME}. {_how_to_get_record()}"
        )
    return found


def _record_file_in(folder_or_file: Path) -> Path | None:
    candidates = (folder_or_file, folder_or_file / CSV_NAME, folder_or_file / MAT_NAME)
    return next((file for file in candidates if file.is_file()), None)


def _cache_folders() -> tuple[Path, Path]:
    return _project_cache(), _benchmarks_cache() / "Silverbox" / "SilverboxFiles"


def _project_cache() -> Path:
    return platformdirs.user_cache_path("duffing-env") / "silverbox"


def _benchmarks_cache() -> Path:
    if sys.platform in ("darwin", "win32"):
        return platformdirs.user_data_path("nonlinear_benchmarks", appauthor=False)
    return Path.home() / ".nonlinear_benchmarks"


def _how_to_get_record() -> str:
    return (
        "It is the Silverbox benchmark of nonlinearbenchmark.org: `pip install "
        "nonlinear_benchmarks`, then nonlinear_benchmarks.Silverbox() in Python downloads it to a "
        f"place that is searched; or put the file into {_project_cache()}, or set "
        f"{ENVIRONMENT_VARIABLE} to the file or its folder"
    )


@lru_cache(maxsize=2)
def _read_record(file: Path) -> SilverboxRecord:
    content = file.read_bytes()
    digest = hashlib.sha256(content).hexdigest()
    if digest == CSV_SHA256:
        u, y = np.loadtxt(io.BytesIO(content), delimiter=",", skiprows=1, usecols=(0, 1), unpack=True)
    elif digest == MAT_SHA256:
        variables = scipy.io.loadmat(io.BytesIO(content))
        u, y = (_round_to_five_digits(variables[name][0]) for name in ("V1", "V2"))
    else:
        raise RecordDamaged(
            f"{file} is not the Silverbox record: its {len(content)} bytes have the SHA-256 "
            f"{digest}, but {CSV_NAME} has {CSV_SHA256} and {MAT_NAME} has {MAT_SHA256}; "
            f"replace it. {_how_to_get_record()}"
        )
    return SilverboxRecord(_read_only(u), _read_only(y))


def _round_to_five_digits(values: NDArray[np.float64]) -> NDArray[np.float64]:
    # By way of text: the CSV's reader gives the double nearest to the decimal number, which
    # rounding by arithmetic does not always give.
    return np.array([float(f"{value:.5g}") for value in values.tolist()])


def _read_only(values: NDArray[np.float64]) -> NDArray[np.float64]:
    values = np.ascontiguousarray(values)
    values.flags.writeable = False
    return values


def regime_input(name: str, rng: np.random.Generator) -> NDArray[np.float64]:
    """Gives the input of a regime: the record's where it is present, else one that `rng` draws.

    Args:
        name: `"multisine"` or `"arrow"`.
        rng: See `synthesise_multisine` and `synthesise_arrow`.

    Returns:
        Input in volts, shape `(samples,)`, not to be written to. The record's is as measured, with
        its mean of 6.2 mV.

    Raises:
        ValueError: There is no regime of this name.
        RecordNotFound: `SILVERBOX_DATA` is set, but the record is not there.
        RecordDamaged: The record's file has a wrong SHA-256.
    """
    if name not in REGIME_NAMES:
        raise ValueError(f"name must be one of {', '.join(REGIME_NAMES)}, but it is {name!r}")
    if record_available():
        record = load_record()
        return record.multisine.u if name == "multisine" else record.arrow.u
    return synthesise_multisine(rng) if name == "multisine" else synthesise_arrow(rng)


def synthesise_multisine(rng: np.random.Generator, realisations: int = 10) -> NDArray[np.float64]:
    """Makes the multisine part of the record from its published description.

    Each realisation is Σ_l A·cos(2π·l·t/8192 + φ_l) over the 1342 odd harmonics l = 1, 3, ..., 2683
    with φ_l independent and uniform on [0, 2π). It lasts 400 samples of transient and one period
    of 8192, of which the transient is the periodic continuation. A gap of 100 zeros stands
    before each realisation and after the last.

    Returns:
        Input in volts, shape `(8692 · realisations + 100,)`, of mean zero; the RMS of every period
        is 22.34 mV, as in the record.

    Raises:
        ValueError: `realisations` is below 1.
    """
    if realisations < 1:
        raise ValueError(f"realisations must be 1 or more, but it is {realisations}")
    phases = rng.uniform(0.0, 2.0 * np.pi, (realisations, ODD_HARMONICS.size))
    amplitude = MULTISINE_RMS * np.sqrt(2.0 / ODD_HARMONICS.size)
    spectrum = np.zeros((realisations, PERIOD_SAMPLES // 2 + 1), dtype=np.complex128)
    spectrum[:, ODD_HARMONICS] = 0.5 * amplitude * np.exp(1j * phases)
    periods = np.fft.irfft(spectrum, PERIOD_SAMPLES, norm="forward")
    gaps = np.zeros((realisations, GAP_SAMPLES))
    parts = np.hstack([gaps, periods[:, -TRANSIENT_SAMPLES:], periods])
    return np.append(parts, np.zeros(GAP_SAMPLES))


def synthesise_arrow(rng: np.random.Generator, samples: int = ARROW_SAMPLES) -> NDArray[np.float64]:
    """Makes the arrow part of the record from its published description.

    White Gaussian noise passes a discrete Butterworth low-pass of order 9 and cut-off 200 Hz; its
    amplitude then grows linearly from zero, over all samples.

    Returns:
        Input in volts, shape `(samples,)`, of mean zero; the standard deviation of the last sample
        is 39 mV, so that 40,100 samples peak near 0.142 V, as the record does without its mean.

    Raises:
        ValueError: `samples` is below 1.
    """
    if samples < 1:
        raise ValueError(f"samples must be 1 or more, but it is {samples}")
    low_pass = scipy.signal.butter(ARROW_ORDER, ARROW_CUTOFF, fs=1.0 / SILVERBOX_SAMPLING_STEP, output="sos")
    impulse_response = scipy.signal.sosfilt(low_pass, np.eye(1, 4096)[0])
    noise = scipy.signal.sosfilt(low_pass, rng.standard_normal(samples))
    unit_noise = noise / np.linalg.norm(impulse_response)
    return np.linspace(0.0, ARROW_END_RMS, samples) * unit_noise
