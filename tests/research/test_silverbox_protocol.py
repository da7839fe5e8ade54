"""The Silverbox protocol: its slices and measures by hand, that it keeps to its rules, and what it reports."""

import json
import math
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from duffing_env.plants.silverbox_record import Regime, SilverboxRecord, synthesise_multisine
from research.studies import silverbox_protocol as module
from research.studies import silverbox_results as reporting
from research.studies.silverbox_protocol import N_GIVEN_OUTPUTS, SETTINGS, TESTS, ProtocolOutcome

ROOT = Path(__file__).parents[2]
MANUAL = ROOT / "docs" / "evidence" / "silverbox.md"


# --- Slices and measures by hand -----------------------------------------------------------------------------------


def test_sections_are_those_of_the_benchmark():
    samples = np.arange(131_072.0)
    sections = module.split_record(SilverboxRecord(samples, -samples))
    # nonlinear_benchmarks: u[40650:127400] of which the first 75 % train, u[100:40575], and of that 32,000.
    whole = samples[40_650:127_400]
    expected = {
        "training": whole[: int(0.75 * len(whole))],
        "multisine": whole[int(0.75 * len(whole)) :],
        "arrow": samples[100:40_575],
        "no_extrapolation": samples[100:32_100],
    }
    for name, u in expected.items():
        section = getattr(sections, name)
        np.testing.assert_array_equal(section.u, u)
        np.testing.assert_array_equal(section.y, -u)
    assert [len(u) for u in expected.values()] == [65_062, 21_688, 40_475, 32_000]


def test_rmse_leaves_out_the_outputs_that_were_given():
    error = np.concatenate([np.full(50, 9.0), [3e-3, 4e-3, 0.0, 0.0]])
    assert module.rmse(error) == pytest.approx(2.5e-3)


def outcome(**changes):
    values = {
        "rmse": dict(zip(TESTS, (3e-4, 4e-4, 3e-4), strict=True)),
        "prediction_rmse": 2e-4,
        "coverage": 0.9,
        "seconds": 1e-6,
        "free_energy": -10.0,
        "learning": {50: 2e-3, 100: 9e-4, 65_062: 4e-4},
        "beliefs": {},
        "arrow_error": np.zeros(3),
    }
    return ProtocolOutcome(**{**values, **changes})


@pytest.mark.parametrize(
    ("errors", "samples"),
    [
        ((2e-3, 9e-4, 4e-4), 100),
        ((9e-4, 9e-4, 4e-4), 50),
        ((9e-4, 2e-3, 4e-4), 1000),  # the error was below 1 mV before, but did not stay there
        ((9e-4, 4e-4, 1e-3), None),
        ((math.nan, math.inf, 4e-4), 1000),
    ],
)
def test_samples_until_the_error_stays_close(errors, samples):
    assert module.samples_until_close(dict(zip((50, 100, 1000), errors, strict=True))) == samples


def test_the_submission_line():
    assert reporting.submission_line([0.25149, 0.3, 1.0]) == "[0.251; 0.300; 1.000]"


# --- The rules, on a simulated oscillator --------------------------------------------------------------------------


@pytest.fixture(scope="module")
def simulated():
    """Training and test records that follow one another, made with the linear interpolation, and a sensor's noise."""
    rng = np.random.default_rng(0)
    u = synthesise_multisine(rng, realisations=1)[:4000]
    y = SETTINGS["ODE linear"].estimator().simulate(u, [0.0, 0.0]) + 3e-4 * rng.standard_normal(4000)
    return Regime("training", u[:2500], y[:2500]), Regime("test", u[2500:], y[2500:])


@pytest.mark.parametrize("passes", [1, 2])
def test_identify_counts_the_first_pass(simulated, passes, monkeypatch):
    training, _ = simulated
    monkeypatch.setattr(module, "perf_counter", iter([10.0, 14.0]).__next__)
    estimator, free_energy, seconds = module.identify(replace(SETTINGS["ODE linear"], passes=passes), training, 2000)
    expected = SETTINGS["ODE linear"].estimator()
    assert free_energy == expected.run(training.u[:2000], training.y[:2000])[:, -1].sum()
    if passes == 2:
        expected.rewind()
        expected.run(training.u[:2000], training.y[:2000])
    assert estimator.belief == expected.belief
    assert seconds == 4.0 / (passes * 2000)


def test_a_simulation_knows_no_more_than_the_first_outputs(simulated):
    training, test = simulated
    estimator, _, _ = module.identify(SETTINGS["ODE spline"], training, 2500)
    error = module.simulation_error(estimator, test)
    unknown = test.y.copy()
    unknown[N_GIVEN_OUTPUTS:] = 7.0
    other = module.simulation_error(estimator, Regime("test", test.u, unknown))
    np.testing.assert_allclose(error + test.y, other + unknown, rtol=0, atol=1e-14)
    np.testing.assert_array_equal(error[:N_GIVEN_OUTPUTS], 0.0)
    assert 2.5e-4 < module.rmse(error) < 1e-3


@pytest.mark.parametrize("name", ["ODE linear", "ODE look-ahead", "NLARX three-tap"])
def test_coverage_compares_each_output_with_its_own_forecast(simulated, name):
    training, test = simulated
    estimator, _, _ = module.identify(SETTINGS[name], training, 2500)
    before = {name: array.copy() for name, array in estimator.arrays().items()}
    # 1,500 outputs: 90 % within 4 standard deviations. Off by one sample, hardly any would be within.
    assert module.coverage(estimator, training, test) == pytest.approx(0.9, abs=0.035)
    for name, array in estimator.arrays().items():
        np.testing.assert_array_equal(array, before[name])
    shifted = Regime("test", test.u, np.roll(test.y, 1))
    assert module.coverage(estimator, training, shifted) < 0.9 - 0.035


def test_mean_field_has_no_coverage(simulated):
    training, test = simulated
    estimator, _, _ = module.identify(SETTINGS["paper as published"], training, 2500)
    assert math.isnan(module.coverage(estimator, training, test))


def test_settings_without_feedthrough_have_none():
    belief = SETTINGS["ODE spline, d = 0"].estimator().belief
    assert "d" not in belief.parameters()
    assert belief.parameters()["y0"][1] > 0


@pytest.mark.slow  # seconds of compilation
def test_selection_uses_the_training_section_only(record, monkeypatch, capsys):
    u, y = (np.full(131_072, np.nan) for _ in range(2))
    training = slice(40_650, 40_650 + 65_062)
    u[training], y[training] = record.u[training], record.y[training]
    monkeypatch.setattr(reporting, "load_record", lambda data: SilverboxRecord(u, y))
    monkeypatch.setattr(
        reporting, "SETTINGS", {"ODE linear": SETTINGS["ODE linear"], "paper": SETTINGS["NLARX offset"]}
    )
    monkeypatch.setattr(reporting, "PROCESS_NOISES", (1e-4,))
    monkeypatch.setattr(reporting, "SUBSTEPS", (2,))
    scores = reporting.compare_on_validation()
    assert {model: list(row) for model, row in scores.items()} == {"ODE linear": ["default", "100 µV", "2 steps"]}
    (default, covers), (noisy, too_wide), (coarse, _) = scores["ODE linear"].values()
    assert default < 0.36e-3 < noisy
    assert covers == pytest.approx(0.9, abs=0.02)
    assert too_wide > 0.95
    assert coarse == pytest.approx(default, rel=0.01)
    assert f"{1e3 * default:.4f}" in capsys.readouterr().out


# --- On the record -------------------------------------------------------------------------------------------------

FEW = ("paper as published", "paper structured", "NLARX offset", *reporting.SUBMITTED_SETTINGS)


@pytest.fixture(scope="module")
def results(record, tmp_path_factory):
    """The protocol with a few settings: (results, folder, what was printed)."""
    folder = tmp_path_factory.mktemp("silverbox")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(reporting, "SETTINGS", {name: SETTINGS[name] for name in FEW})
        patch.setattr(module, "TRAINING_LENGTHS", (100, 500, module.TRAINING_SAMPLES))
        patch.setattr(module, "N_TIMINGS", 1)
        with patch.context() as output:
            printed = []
            output.setattr(reporting, "print_texts_and_tables", lambda *parts: printed.extend(parts))
            found = reporting.run_protocol(json=folder / "new" / "results.json", figures=folder / "figures")
    return found, folder, printed


def triple(results, name):
    return [1e3 * results["rows"][name]["rmse"][test] for test in TESTS]


def test_the_paper_s_row_is_that_of_independent_measurements(results):
    # Measured by another program, a port of the published messages: 30.4, 30.7 and 24.1 mV.
    assert triple(results[0], "paper as published") == pytest.approx([30.4, 30.7, 24.1], abs=0.1)


@pytest.mark.parametrize(
    ("name", "bounds"),
    [
        ("ODE linear", (0.36, 0.45, 0.36)),
        ("ODE look-ahead +e", (0.33, 0.40, 0.33)),
        ("ODE spline +e, 2 passes", (0.25, 0.39, 0.26)),
        ("NLARX three-tap", (0.45, 0.65, 0.46)),
    ],
)
def test_errors(results, name, bounds):
    for error, bound in zip(triple(results[0], name), bounds, strict=True):
        assert error <= bound


def test_intervals_hold_and_the_arrow_is_learned_early(results):
    rows = results[0]["rows"]
    for name in ("ODE linear", "ODE look-ahead +e", "ODE spline +e, 2 passes"):
        assert 0.87 <= rows[name]["coverage"] <= 0.93
        assert rows[name]["samples_until_1_mV"] <= 500
    assert rows["paper as published"]["coverage"] is None
    assert rows["paper as published"]["samples_until_1_mV"] is None


def test_free_energy_ranks_models_as_their_simulation_errors_do(results):
    names = ("paper structured", "NLARX offset", "NLARX three-tap", "ODE linear")
    rows = results[0]["rows"]
    by_error = sorted(names, key=lambda name: rows[name]["rmse"]["multisine"])
    assert by_error == sorted(names, key=lambda name: rows[name]["free_energy"]) == list(reversed(names))


def test_results_are_written_whole(results):
    found, folder, _ = results
    assert json.loads((folder / "new" / "results.json").read_text()) == json.loads(json.dumps(found))
    assert sorted(path.name for path in (folder / "figures").iterdir()) == [
        "silverbox_arrow.png",
        "silverbox_learning.png",
        "silverbox_parameters.png",
    ]
    assert list((folder / "new").iterdir()) == [folder / "new" / "results.json"]
    assert list(found["rows"]) == list(FEW)
    parameters = found["rows"]["ODE linear"]["parameters"]
    assert parameters["a"]["mean"] / parameters["m"]["mean"] == pytest.approx(1.843e5, rel=1e-3)
    assert found["rows"]["ODE linear"]["interpolation"] == "linear"


def test_figures_show_something(results):
    from matplotlib.image import imread

    for path in (results[1] / "figures").iterdir():
        image = imread(path)[..., :3]
        assert min(image.shape[:2]) >= 400
        assert image.std() > 0.05


def test_the_manual_shows_what_is_printed(results):
    manual = MANUAL.read_text(encoding="utf-8")
    for name in FEW:
        row = next(line for line in manual.splitlines() if line.startswith(f"{name}  "))
        assert row.removeprefix(name).split()[:3] == [f"{error:.3f}" for error in triple(results[0], name)]
    printed = [str(part) for part in results[2]]
    for name in reporting.SUBMITTED_SETTINGS:
        line = f"  {name:24} {reporting.submission_line(triple(results[0], name))}"
        assert line in printed
        assert line in manual


# --- The command ---------------------------------------------------------------------------------------------------


def command(*arguments):
    return subprocess.run(
        [sys.executable, ROOT / "reproduce.py", *arguments], env=os.environ, capture_output=True, text=True, timeout=600
    )


def test_command_explains_itself():
    finished = command("silverbox", "--help")
    assert finished.returncode == 0
    for word in ("reproduce.py silverbox", "--json", "--figures", "--data", "--select", "SNLS80mV.csv"):
        assert word in finished.stdout
    assert "reproduce.py silverbox" in command("--help").stdout


@pytest.mark.parametrize("option", ["--select", "--no-select"])
def test_command_without_a_record(tmp_path, option):
    finished = command("silverbox", "--data", str(tmp_path), "--figures", str(tmp_path / "figures"), option)
    assert finished.returncode == 2
    assert f"path is {tmp_path}, but the Silverbox record is not there" in finished.stderr
    assert "Traceback" not in finished.stderr
    assert not (tmp_path / "figures").exists()


def test_nowhere_to_write(record, tmp_path):
    with pytest.raises(IsADirectoryError, match="json must be a file, but is the folder"):
        reporting.run_protocol(json=tmp_path, figures=tmp_path / "figures")
