"""The paper's experiment: against the published numbers, a hand example of the measures, and the command itself."""

import json
import math
import os
import subprocess
import sys
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from duffing_env.plants.silverbox_record import CSV_NAME
from estimator.inference.pem_narx import PEMNARX
from research.studies import kouw2020 as module
from research.studies.kouw2020 import PUBLISHED, SETTINGS, prediction_mse, reproduce, simulation_mse

ROOT = Path(__file__).parents[2]
MANUAL = ROOT / "docs" / "evidence" / "reproduction.md"
FEM = ("FEM-LARX", "FEM-NLARX")


@pytest.fixture(scope="module")
def outcome(record, tmp_path_factory):
    """One run of everything: (results, folder). The baseline is its linear part only, which is fitted at once."""
    folder = tmp_path_factory.mktemp("reproduction")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "PEMNARX", partial(PEMNARX, units=0))
        results = reproduce(json=folder / "new" / "results.json", figures=folder / "figures")
    return results, folder


@pytest.mark.parametrize("model", FEM)
@pytest.mark.parametrize("setting", ["as_published", "through_environment"])
def test_published_numbers(outcome, setting, model):
    # Written out once more: the targets must not come from the module under test.
    published = {"FEM-LARX": (5.9446129987526364e-05, 1.0204335589997665e-03),
                 "FEM-NLARX": (5.8304968780121563e-05, 9.256401174690808e-04)}  # fmt: skip
    errors = outcome[0][setting][model]
    assert (errors["prediction_mse"], errors["simulation_mse"]) == pytest.approx(published[model], rel=1e-9)


def test_the_environment_changes_nothing(outcome):
    results, _ = outcome
    for model in FEM:
        assert results["through_environment"][model] == pytest.approx(results["as_published"][model], rel=1e-12)


def test_an_input_delay_of_one_lowers_every_error_severalfold(outcome):
    results, _ = outcome
    for setting in ("as_derived", "structured"):
        for model, errors in results[setting].items():
            for measure, mse in errors.items():
                assert mse < 0.3 * PUBLISHED[model][measure], (setting, model, measure)


def test_results_are_complete_and_written(outcome):
    results, folder = outcome
    assert json.loads((folder / "new" / "results.json").read_text()) == json.loads(json.dumps(results))
    assert list(results) == ["published", *SETTINGS, "meta"]
    for name in ("published", "as_published", "through_environment", "as_derived", "structured"):
        assert set(FEM) <= set(results[name])
    for name in ("published", "as_published", "as_derived"):
        assert "PEM-NARX" in results[name]
    for name in ("published", *SETTINGS):
        for errors in results[name].values():
            assert set(errors) == {"prediction_mse", "simulation_mse"}
            assert all(0 < mse < 1 for mse in errors.values())
    meta = results["meta"]
    assert meta["samples"] == {"training": 90_972, "validation": 40_100}
    assert meta["versions"]["numpy"] == np.__version__
    assert {name: set(models) for name, models in meta["seconds"].items()} == {
        name: set(results[name]) for name in SETTINGS
    }


def test_figures(outcome):
    from matplotlib.image import imread

    _, folder = outcome
    assert sorted(path.name for path in (folder / "figures").iterdir()) == [
        "prediction_error.png",
        "simulation_error.png",
    ]
    for path in (folder / "figures").iterdir():
        image = imread(path)
        assert image.shape[0] >= 400
        assert image.shape[1] >= 900
        assert image[..., :3].std() > 0.05  # not blank


def test_no_file_is_left_half_written(outcome):
    _, folder = outcome
    assert not [path for path in folder.rglob("*") if path.name.endswith(".part")]


def test_the_manual_shows_what_is_printed(outcome, capsys):
    module.report(outcome[0])
    rows = [line.strip() for line in capsys.readouterr().out.splitlines() if "FEM-" in line and "e-0" in line]
    assert len(rows) == 2 * (1 + len(SETTINGS))
    manual = MANUAL.read_text(encoding="utf-8")
    assert [row for row in rows if row not in manual] == []


def test_drawn_series_is_every_80th_sample(record):
    y = record.arrow.y
    run = module.ValidationRun(
        prediction=y + 0.1, simulation=y - 0.2, prediction_mse=0.01, simulation_mse=0.04, seconds=0.0
    )
    figure = module.draw_errors({"FEM-NLARX": run}, record.arrow, "simulation")
    upper, lower = figure.axes
    output, error = upper.lines
    np.testing.assert_array_equal(output.get_xdata(), np.arange(0, 40_100, 80))
    np.testing.assert_array_equal(output.get_ydata(), y[::80] - 0.2)
    np.testing.assert_allclose(error.get_ydata(), 0.04)
    np.testing.assert_allclose(lower.lines[0].get_ydata(), 0.04)
    assert lower.get_yscale() == "log"
    assert lower.get_xlabel() == "sample"
    assert "V²" in lower.get_ylabel()


def test_prediction_measure_by_hand():
    y = np.array([9.0, 9.0, 3.0, 1.0, 2.0])
    predicted = np.array([5.0, 5.0, 100.0, 1.5, 4.0])
    # (0 - 3)², (1.5 - 1)², (4 - 2)²: the prediction of the third sample does not count, its zero does
    assert prediction_mse(predicted, y) == pytest.approx((9.0 + 0.25 + 4.0) / 3, rel=1e-15)


def test_simulation_measure_by_hand():
    y = np.array([9.0, 9.0, 3.0, 1.0, 2.0])
    simulated = np.array([5.0, 5.0, 3.5, 1.5, 4.0])
    # (3.5 - 3)², (1.5 - 1)², (4 - 2)²: the two outputs that were given do not count
    assert simulation_mse(simulated, y) == pytest.approx((0.25 + 0.25 + 4.0) / 3, rel=1e-15)


def test_measures_leave_their_arguments_alone():
    predicted, y = np.array([1.0, 2.0, 3.0, 4.0]), np.zeros(4)
    prediction_mse(predicted, y)
    np.testing.assert_array_equal(predicted, [1.0, 2.0, 3.0, 4.0])


def test_measures_do_not_hide_a_diverging_model():
    y = np.zeros(5)
    assert math.isnan(simulation_mse(np.array([0.0, 0.0, 1.0, np.nan, np.nan]), y))


def command(*arguments, **environment):
    return subprocess.run(
        [sys.executable, ROOT / "reproduce.py", *arguments],
        env=os.environ | environment,
        capture_output=True,
        text=True,
        timeout=600,
    )


def test_command_without_a_record(tmp_path):
    finished = command("--data", str(tmp_path), "--figures", str(tmp_path / "figures"))
    assert finished.returncode == 2
    assert f"path is {tmp_path}, but the Silverbox record is not there" in finished.stderr
    assert "nonlinearbenchmark.org" in finished.stderr
    assert "Traceback" not in finished.stderr
    assert not (tmp_path / "figures").exists()


def test_command_with_a_damaged_record(tmp_path):
    (tmp_path / CSV_NAME).write_text("V1,V2\n0.1,0.2\n")
    finished = command("--data", str(tmp_path / CSV_NAME))
    assert finished.returncode == 2
    assert "is not the Silverbox record" in finished.stderr
    assert "Traceback" not in finished.stderr


def test_command_with_nowhere_to_write(record, tmp_path):
    finished = command("--json", str(tmp_path), "--figures", str(tmp_path))
    assert finished.returncode == 2
    assert f"json must be a file, but is the folder {tmp_path}" in finished.stderr
    assert "Traceback" not in finished.stderr


def test_command_explains_every_option():
    finished = command("--help")
    assert finished.returncode == 0
    for word in ("--json", "--figures", "--data", "JSON file", "two figures", "SNLS80mV.csv"):
        assert word in finished.stdout
