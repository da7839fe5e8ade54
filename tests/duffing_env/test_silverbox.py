"""The Silverbox record: where it is searched, what is refused, and its synthesised regimes."""

import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.signal import welch

from duffing_env.plants import silverbox_record
from duffing_env.plants.silverbox_record import (
    RecordDamaged,
    RecordNotFound,
    load_record,
    record_available,
    regime_input,
    synthesise_arrow,
    synthesise_multisine,
)

SAMPLING_FREQUENCY = 1e7 / 2**14
PROJECT_CACHE = Path(".cache/duffing-env/silverbox")
BENCHMARKS_CACHE = Path(".nonlinear_benchmarks/Silverbox/SilverboxFiles")


@pytest.fixture
def bare_home(tmp_path, monkeypatch):
    """A home without any record, and no variable that names one."""
    if sys.platform != "linux":
        pytest.skip("the places in a home folder are written out for Linux only")
    for variable in ("SILVERBOX_DATA", "XDG_CACHE_HOME"):
        monkeypatch.delenv(variable, raising=False)
    monkeypatch.setenv("HOME", str(tmp_path))
    return tmp_path


@pytest.fixture(scope="session")
def record_folder(record):
    """The folder of the real files, found before any test changes the environment."""
    return silverbox_record._find_record_file(None).parent


def junk(folder: Path, name: str = "SNLS80mV.csv") -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    file = folder / name
    file.write_text('"V1","V2",\n0.1,0.2,\n')
    return file


def test_first_and_last_rows_are_those_of_the_file(record):
    assert record.u.shape == record.y.shape == (131_072,)
    assert record.u.dtype == record.y.dtype == np.float64
    assert (record.u[0], record.y[0]) == (0.0057756, 0.0093978)
    assert (record.u[-1], record.y[-1]) == (0.0096732, -0.0072247)


def test_regimes_are_the_published_split(record):
    assert (record.arrow.name, record.multisine.name) == ("arrow", "multisine")
    assert record.arrow.u.size == 40_100
    assert record.multisine.y.size == 90_972
    for signal in ("u", "y"):
        parts = [getattr(record.arrow, signal), getattr(record.multisine, signal)]
        np.testing.assert_array_equal(np.concatenate(parts), getattr(record, signal))


def test_the_arrow_is_played_again_at_the_end(record):
    again, first = record.multisine.u[-3652:], record.arrow.u[:3652]
    assert np.corrcoef(again, first)[0, 1] > 0.98
    assert np.corrcoef(again[1:], first[:-1])[0, 1] < 0.9


def test_record_cannot_be_overwritten(record):
    for values in (record.u, record.y, record.arrow.u, record.multisine.y):
        with pytest.raises(ValueError, match="read-only"):
            values[0] = 0.0


def test_both_file_kinds_give_the_identical_record(record_folder):
    files = [record_folder / name for name in ("SNLS80mV.csv", "SNLS80mV.mat")]
    if not all(file.is_file() for file in files):
        pytest.skip(f"not both kinds of file are in {record_folder}")
    csv, mat = map(load_record, files)
    assert csv is not mat
    np.testing.assert_array_equal(csv.u, mat.u)
    np.testing.assert_array_equal(csv.y, mat.y)


def test_a_file_is_read_once(record, record_folder):
    assert load_record() is record
    assert load_record(record_folder) is load_record(str(record_folder))


@pytest.mark.parametrize("place", [PROJECT_CACHE, BENCHMARKS_CACHE])
def test_caches_are_searched(record, record_folder, bare_home, place):
    assert not record_available()
    (bare_home / place).parent.mkdir(parents=True)
    (bare_home / place).symlink_to(record_folder)
    assert record_available()
    np.testing.assert_array_equal(load_record().u, record.u)


def test_search_order(bare_home, monkeypatch):
    # A damaged file stops the search and is named: so it tells which place was looked at first.
    def found_first(path=None):
        with pytest.raises(RecordDamaged) as error:
            load_record(path)
        return Path(str(error.value).split(" is not")[0])

    benchmarks = junk(bare_home / BENCHMARKS_CACHE, "SNLS80mV.mat")
    assert found_first() == benchmarks
    project_mat = junk(bare_home / PROJECT_CACHE, "SNLS80mV.mat")
    assert found_first() == project_mat
    project_csv = junk(bare_home / PROJECT_CACHE)
    assert found_first() == project_csv
    in_variable = junk(bare_home / "variable")
    for named in (in_variable, in_variable.parent, "~/variable"):
        monkeypatch.setenv("SILVERBOX_DATA", str(named))
        assert found_first() == in_variable
    explicit = junk(bare_home / "explicit", "another name.csv")
    assert found_first(explicit) == explicit


def test_missing_record_says_where_to_get_it_and_what_was_searched(bare_home):
    assert not record_available()
    with pytest.raises(RecordNotFound) as error:
        load_record()
    message = str(error.value)
    for part in (
        "nonlinearbenchmark.org",
        "pip install nonlinear_benchmarks",
        "nonlinear_benchmarks.Silverbox()",
        "SILVERBOX_DATA",
        str(bare_home / PROJECT_CACHE),
        str(bare_home / BENCHMARKS_CACHE),
    ):
        assert part in message
    assert isinstance(error.value, FileNotFoundError)


def test_named_place_without_record_is_an_error_at_once(bare_home, monkeypatch):
    junk(bare_home / PROJECT_CACHE)  # must not even be looked at
    absent = bare_home / "absent"
    with pytest.raises(RecordNotFound, match=f"path is {absent}, but .* not there"):
        load_record(absent)
    monkeypatch.setenv("SILVERBOX_DATA", str(absent))
    for search in (load_record, record_available):
        with pytest.raises(RecordNotFound, match=f"SILVERBOX_DATA is {absent}"):
            search()
    with pytest.raises(RecordNotFound):
        regime_input("arrow", np.random.default_rng(0))
    absent.mkdir()  # a folder without the record
    with pytest.raises(RecordNotFound, match=f"SILVERBOX_DATA is {absent}"):
        load_record()


def test_empty_variable_is_as_good_as_unset(bare_home, monkeypatch):
    monkeypatch.setenv("SILVERBOX_DATA", "")
    assert not record_available()


def test_damaged_file_is_named_and_never_passed_over(bare_home):
    damaged = junk(bare_home / BENCHMARKS_CACHE)
    assert record_available()
    with pytest.raises(RecordDamaged, match=f"{damaged} is not .* SHA-256 [0-9a-f]{{64}}"):
        load_record()
    with pytest.raises(RecordDamaged):
        regime_input("multisine", np.random.default_rng(0))


def test_truncated_record_is_refused(record_folder, tmp_path):
    original = next(record_folder.glob("SNLS80mV.*"))
    copy = tmp_path / original.name
    copy.write_bytes(original.read_bytes()[:-1])
    with pytest.raises(RecordDamaged, match="replace it"):
        load_record(copy)


def test_multisine_has_exactly_the_1342_odd_harmonics_at_one_amplitude():
    u = synthesise_multisine(np.random.default_rng(1))
    odd = np.arange(1, 2684, 2)
    assert odd.size == 1342
    for start in 500 + 8692 * np.arange(10):
        amplitude = 2.0 * np.abs(np.fft.rfft(u[start : start + 8192])) / 8192
        np.testing.assert_allclose(amplitude[odd], 0.02234 * np.sqrt(2 / 1342), rtol=1e-9)
        np.testing.assert_allclose(np.delete(amplitude, odd), 0.0, atol=1e-15)


def test_multisine_follows_the_record_layout():
    u = synthesise_multisine(np.random.default_rng(2), realisations=3)
    assert u.shape == (3 * 8692 + 100,)
    gaps = np.flatnonzero(u == 0.0)
    expected = 8692 * np.arange(4)[:, None] + np.arange(100)
    np.testing.assert_array_equal(gaps, expected.ravel())
    for start in 100 + 8692 * np.arange(3):
        transient, period = u[start : start + 400], u[start + 400 : start + 8592]
        np.testing.assert_array_equal(transient, period[-400:])
        assert np.sqrt(np.mean(period**2)) == pytest.approx(0.02234, rel=1e-12)


def test_multisine_phases_are_uniform_and_differ_between_realisations():
    u = synthesise_multisine(np.random.default_rng(3))
    periods = u[:-100].reshape(10, 8692)[:, 500:]
    phases = np.angle(np.fft.rfft(periods)[:, 1:2684:2])
    # Of 13,420 independent uniform phases, |mean of exp(iφ)| exceeds 0.026 once in 8700 times.
    assert abs(np.exp(1j * phases).mean()) < 0.026
    assert abs(np.exp(1j * np.diff(phases, axis=0)).mean()) < 0.03


def test_arrow_grows_linearly_from_zero():
    # 40 arrows, 40 blocks each: the relative error of a block's RMS is about 0.4 %.
    rng = np.random.default_rng(4)
    arrows = np.array([synthesise_arrow(rng) for _ in range(40)])
    assert arrows.shape == (40, 40_100)
    assert np.all(arrows[:, 0] == 0.0)
    rms = np.sqrt(np.mean(arrows[:, :40_000].reshape(40, 40, 1000) ** 2, axis=(0, 2)))
    expected = 0.039 * (np.arange(40) + 0.5) * 1000 / 40_100
    np.testing.assert_allclose(rms[1:], expected[1:], rtol=0.025)
    assert np.mean(np.abs(arrows).max(axis=1)) == pytest.approx(0.142, abs=0.006)


def test_arrow_is_band_limited_to_200_hz():
    u = synthesise_arrow(np.random.default_rng(5), 200_000)
    frequency, power = welch(u, SAMPLING_FREQUENCY, nperseg=2048)
    level = power[(frequency > 10) & (frequency < 190)].mean()
    at_cutoff = power[(frequency > 198) & (frequency < 202)].mean() / level
    assert at_cutoff == pytest.approx(0.5, abs=0.1)
    # The magnitude-squared of a Butterworth low-pass, by the bilinear transform's warping.
    warped = np.tan(np.pi * 215 / SAMPLING_FREQUENCY) / np.tan(np.pi * 200 / SAMPLING_FREQUENCY)
    near_215 = power[np.argmin(np.abs(frequency - 215))] / level
    assert near_215 == pytest.approx(1 / (1 + warped**18), rel=0.4)
    assert power[frequency > 250].max() < 1e-4 * level


def test_arrow_is_gaussian_with_unit_ramp_removed():
    u = synthesise_arrow(np.random.default_rng(6))
    ramp = np.arange(40_100) / 40_099
    z = u[100:] / (0.039 * ramp[100:])
    assert np.mean(z**2) == pytest.approx(1.0, abs=0.05)
    assert np.mean(z**4) == pytest.approx(3.0, abs=0.25)


@pytest.mark.parametrize("synthesise", [synthesise_multisine, synthesise_arrow])
def test_one_seed_gives_one_signal(synthesise):
    first, again, other = (synthesise(np.random.default_rng(seed)) for seed in (7, 7, 8))
    np.testing.assert_array_equal(first, again)
    assert not np.array_equal(first, other)


def test_lengths_below_one_are_refused():
    rng = np.random.default_rng(0)
    with pytest.raises(ValueError, match="realisations must be 1 or more, but it is 0"):
        synthesise_multisine(rng, realisations=0)
    with pytest.raises(ValueError, match="samples must be 1 or more, but it is 0"):
        synthesise_arrow(rng, samples=0)


def test_synthesised_multisine_has_the_statistics_of_the_record(record):
    # The record's steady periods begin near row 40,986 + 8692 i (0-based); its mean is 6.2 mV.
    # The generator's analogue filter slopes its spectrum, so that only the power compares.
    starts = 40_986 + 8692 * np.arange(10)
    periods = np.array([record.u[start : start + 8192] for start in starts])
    made = synthesise_multisine(np.random.default_rng(9))[:-100].reshape(10, 8692)[:, 500:]
    np.testing.assert_allclose(periods.std(axis=1), made.std(axis=1), rtol=2e-3)
    peaks = np.abs(periods - periods.mean()).max(axis=1)
    assert np.abs(made).max(axis=1).mean() == pytest.approx(peaks.mean(), rel=0.1)
    power = np.abs(np.fft.rfft(periods[0] - periods[0].mean())) ** 2
    assert power[1:2684:2].sum() > 0.999 * power.sum()


def test_synthesised_arrow_has_the_statistics_of_the_record(record):
    recorded = record.arrow.u - record.u.mean()
    rng = np.random.default_rng(10)
    made = np.array([synthesise_arrow(rng) for _ in range(10)])
    assert np.sqrt(np.mean(made**2)) == pytest.approx(recorded.std(), rel=0.05)
    peaks = np.abs(made).max(axis=1)
    assert peaks.min() < np.abs(recorded).max() < peaks.max()


def test_regime_input_is_the_record_where_it_is_present(record):
    rng = np.random.default_rng(11)
    before = rng.bit_generator.state
    assert np.shares_memory(regime_input("multisine", rng), record.multisine.u)
    assert np.shares_memory(regime_input("arrow", rng), record.arrow.u)
    np.testing.assert_array_equal(regime_input("arrow", rng), record.u[:40_100])
    assert rng.bit_generator.state == before


def test_regime_input_is_synthesised_where_the_record_is_absent(bare_home):
    for name, synthesise in (("multisine", synthesise_multisine), ("arrow", synthesise_arrow)):
        expected = synthesise(np.random.default_rng(12))
        np.testing.assert_array_equal(regime_input(name, np.random.default_rng(12)), expected)


def test_unknown_regime_is_refused_with_the_names():
    with pytest.raises(ValueError, match="one of multisine, arrow, but it is 'chirp'"):
        regime_input("chirp", np.random.default_rng(0))
