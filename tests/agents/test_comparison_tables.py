"""The leaderboard: intervals, table, JSON and figures, from evaluations with known metrics."""

import json
from dataclasses import asdict, replace
from unittest.mock import ANY

import matplotlib.image
import numpy as np
import pytest
from tables import table

import agents.evaluation.figures
import agents.evaluation.policy_evaluation
from agents.evaluation.comparison import compare_policies
from agents.evaluation.comparison_tables import (
    ComparisonSettings,
    comparison_table,
    policy_by_estimator_table,
    print_comparison_table,
    print_estimator_table,
    print_headline_table,
    write_evaluations,
)
from agents.evaluation.figures import plot_inputs_and_outputs, plot_learning_curve, plot_log_posterior_gain, save_png
from agents.evaluation.metric_summary import METRIC_COLUMNS, summarise_metrics
from agents.evaluation.policy_rollout import Evaluation
from estimator import SILVERBOX_SAMPLING_STEP
from estimator.rigs.units import VOLT_SCALES, Scales

# What the table must print for these values, by hand: centre, then both ends of an interval of width zero.
CONSTANTS = {
    "information_gain": (12.345, "information gained / nat", "12.35"),
    "log_posterior_gain": (-1.004, "log posterior gain / nat", "-1.00"),
    "error_m": (0.012344, "error of m / %", "1.234"),
    "error_c": (0.5, "error of c / %", "50.00"),
    "error_a": (0.00025, "error of a / %", "0.025"),
    "error_b": (2.0, "error of b / %", "200.00"),
    "coverage_50": (0.501, "50 % intervals that cover / %", "50.1"),
    "coverage": (0.75, "90 % intervals that cover / %", "75.0"),
    "coverage_95": (0.9444, "95 % intervals that cover / %", "94.4"),
    "nees": (1.0049, "NEES per coefficient", "1.00"),
    "ended_early": (0.0, "episodes ended early / %", "0.0"),
    "input_power": (0.0225, "input power / mV²", "22500"),
    "input_peak": (0.14996, "input peak / mV", "150.0"),
    "crest_factor": (2.987, "crest factor", "2.99"),
    "decision_time": (3.14e-6, "time per decision / µs", "3.14"),
    "fisher_gain": (19.394, "Fisher information / nat", "19.39"),
    "efficiency": (0.8766, "D-efficiency, of the best known / %", "87.7"),
    "certified": (0.8123, "at least, of what is possible / %", "81.2"),
    "silverbox_equivalent": (10707.6, "Silverbox equivalent / samples", "10708"),
    "full_peak_equivalent": (6037.2, "the same at full peak / samples", "6037"),
    "simulation_rmse": (0.0004216, "RMSE on the twin's arrow / mV", "0.422"),
    "arrow_rmse": (0.00512, "RMSE on the real arrow / mV", "5.12"),
}


def make_evaluation(policy="policy", *, samples=20, systems=30, seed=0, shift=0.0, **metrics):
    rng = np.random.default_rng(seed)
    if not metrics:
        # In units of a hundred at most, so that no cell is wider than its column.
        metrics = {
            name: rng.uniform(0, 1, systems) / max(1, metric.scale / 100) for name, metric in METRIC_COLUMNS.items()
        }
        metrics["log_posterior_gain"] = metrics["log_posterior_gain"] + shift
    curve = np.cumsum(rng.normal(1.0, 0.3, (samples + 1, systems)), axis=0) + shift
    inputs, outputs = rng.uniform(-0.1, 0.1, (2, samples, systems))
    return Evaluation(policy, metrics, curve, inputs, outputs, VOLT_SCALES)


def test_every_metric_of_an_evaluation_has_a_column(monkeypatch):
    monkeypatch.setattr(agents.evaluation.policy_evaluation, "record_available", lambda: False)
    (evaluation,) = agents.evaluation.policy_evaluation.evaluate_policies(
        ["uniform"], systems=2, options={"horizon": 5}
    )
    others = {
        "efficiency",
        "certified",
        "silverbox_equivalent",
        "full_peak_equivalent",
        "simulation_rmse",
        "arrow_rmse",
    }
    assert [*evaluation.metrics] == [name for name in METRIC_COLUMNS if name not in others]
    assert set(CONSTANTS) == set(METRIC_COLUMNS)


def test_centres_are_means_and_medians():
    values = np.array([1.0, 2.0, 3.0, 10.0, 100.0])
    summary = summarise_metrics(make_evaluation(**dict.fromkeys(METRIC_COLUMNS, values)))
    medians = {"error_m", "error_c", "error_a", "error_b", "silverbox_equivalent", "simulation_rmse", "arrow_rmse"}
    medians |= {"full_peak_equivalent"}
    for name, entry in summary.items():
        kind, expected = ("median", 3.0) if name in medians else ("mean", 23.2)
        assert set(entry) == {kind, "low", "high"}
        assert entry[kind] == pytest.approx(expected)
        assert entry["low"] < entry[kind] < entry["high"]
        assert values.min() <= entry["low"]
        assert entry["high"] <= values.max()


@table("seed", range(5))
def test_intervals_contain_the_centre(seed):
    for name, entry in summarise_metrics(make_evaluation(seed=seed, systems=12)).items():
        center = entry.get("mean", entry.get("median"))
        assert entry["low"] <= center <= entry["high"], name
        assert entry["low"] < entry["high"]


def test_intervals_cover_the_mean_at_about_their_rate():
    rng = np.random.default_rng(0)
    repetitions, systems, mean = 400, 60, 2.0
    covered, widths = 0, []
    for _ in range(repetitions):
        entry = summarise_metrics(make_evaluation(log_posterior_gain=rng.gamma(4.0, mean / 4.0, systems)))[
            "log_posterior_gain"
        ]
        covered += entry["low"] <= mean <= entry["high"]
        widths.append(entry["high"] - entry["low"])
    # A percentile interval of 60 values covers a little below 95 %; three standard errors are 3.3 %.
    assert 0.90 < covered / repetitions < 0.985
    assert np.mean(widths) == pytest.approx(2 * 1.96 * 1.0 / np.sqrt(systems), rel=0.05)  # the gamma's std is 1


def test_the_interval_is_a_percentile_bootstrap_and_reproducible():
    values = np.random.default_rng(1).normal(size=50)
    evaluation = make_evaluation(coverage=values)
    first, again, other = (summarise_metrics(evaluation, seed)["coverage"] for seed in (0, 0, 1))
    assert first == again != other
    rng = np.random.default_rng(2)
    means = values[rng.integers(0, 50, (20_000, 50))].mean(axis=1)
    low, high = np.percentile(means, [2.5, 97.5])
    assert (first["low"], first["high"]) == pytest.approx((low, high), abs=0.03)


def test_a_constant_metric_has_an_interval_of_width_zero():
    assert summarise_metrics(make_evaluation(ended_early=np.zeros(9), error_m=np.full(9, 0.25))) == {
        "ended_early": {"mean": 0.0, "low": 0.0, "high": 0.0},
        "error_m": {"median": 0.25, "low": 0.25, "high": 0.25},
    }


def test_of_several_seeds_the_centre_is_the_interquartile_mean(capsys):
    rng = np.random.default_rng(0)
    seeds, systems = 5, 60
    difficulty = rng.normal(0, 1, systems)  # the same systems under every seed
    gained = 20 + difficulty + np.arange(seeds)[:, None] + 0.1 * rng.normal(size=(seeds, systems))
    early = (rng.uniform(size=(seeds, systems)) < 0.05).astype(float)
    group = replace(make_evaluation("ppo", log_posterior_gain=gained.ravel(), ended_early=early.ravel()), seeds=seeds)
    entry = summarise_metrics(group)["log_posterior_gain"]
    assert set(entry) == {"iqm", "low", "high", "seeds", "median_of_seeds"}
    ordered = np.sort(gained.ravel())
    assert entry["iqm"] == pytest.approx(ordered[75:225].mean())
    assert entry["seeds"] == pytest.approx(gained.mean(axis=1))
    assert entry["median_of_seeds"] == pytest.approx(gained.mean(axis=1)[2])
    # Systems are resampled together, because they are the same for all seeds: by themselves, they would average out.
    resampled = [np.sort(gained[:, rng.integers(0, systems, systems)].ravel())[75:225].mean() for _ in range(4000)]
    assert (entry["low"], entry["high"]) == pytest.approx(tuple(np.percentile(resampled, [2.5, 97.5])), abs=0.05)
    # An interquartile mean of rare events would be 0.
    assert summarise_metrics(group)["ended_early"]["mean"] == pytest.approx(early.mean()) != 0
    capsys.readouterr()
    print_comparison_table([group, make_evaluation("uniform", log_posterior_gain=np.zeros(3))], "a title")
    printed = capsys.readouterr().out
    assert "ppo (5 seeds)" in printed
    assert f"median seed {entry['median_of_seeds']:.2f}" in printed
    assert "interquartile" in printed


def test_diverged_free_runs_make_the_interval_infinite_not_the_median():
    values = np.append(np.linspace(1.0, 2.0, 13), [np.inf] * 8)
    entry = summarise_metrics(make_evaluation(arrow_rmse=values))["arrow_rmse"]
    assert entry["median"] == values[10]
    assert 1.0 < entry["low"] < entry["median"]
    assert entry["high"] == np.inf
    assert summarise_metrics(make_evaluation(arrow_rmse=np.full(4, np.inf)))["arrow_rmse"] == {
        "median": np.inf, "low": np.inf, "high": np.inf,
    }  # fmt: skip


def _rows(lines, border):
    return [[cell.strip() for cell in line.split(border)[1:-1]] for line in lines if line.startswith(border)]


def table_of(capsys, *evaluations):
    """The printed table: titles to lists of cells (centre, interval), by column; and the column heads."""
    capsys.readouterr()
    print_comparison_table(list(evaluations), "a title")
    lines = capsys.readouterr().out.splitlines()
    assert any("a title" in line for line in lines)
    assert max(map(len, lines)) <= 80
    head, cells = [], {}
    begins = [k for k, line in enumerate(lines) if line.startswith("┏")]
    for begin, end in zip(begins, [*begins[1:], None], strict=True):  # a wide table comes in parts
        part = lines[begin:end]
        head += ["".join(parts) for parts in zip(*_rows(part, "┃"), strict=True)][1:]  # long names are folded
        body = _rows(part, "│")
        for centers, intervals in zip(body[::2], body[1::2], strict=True):
            assert intervals[0] == ""
            cells.setdefault(centers[0], []).extend(zip(centers[1:], intervals[1:], strict=True))
    return head, cells


def test_the_table_prints_every_metric_in_its_unit(capsys):
    metrics = {name: np.full(3, value) for name, (value, _, _) in CONSTANTS.items()}
    head, cells = table_of(capsys, make_evaluation("constant", **metrics))
    assert head == ["constant"]
    assert cells == {title: [(text, f"[{text}, {text}]")] for _, title, text in CONSTANTS.values()}
    assert list(cells) == [title for _, title, _ in CONSTANTS.values()]


def test_the_two_way_table_has_a_row_for_each_policy_and_estimator(capsys):
    names = ("error_m", "error_c", "error_a", "error_b", "coverage", "nees")
    found = {name: np.array([0.01, 0.02, 0.06]) for name in (*names, "coverage_50")}
    evaluations = [
        replace(make_evaluation(policy), estimator_metrics={"structured": found, "mean_field": found})
        for policy in ("one", "two")
    ]
    print_estimator_table(evaluations)
    printed = capsys.readouterr().out
    assert "other estimators on the same inputs and outputs" in printed
    heads, rows = policy_by_estimator_table(evaluations)
    assert heads[2:] == [METRIC_COLUMNS[name].title for name in names]
    assert all(cell in printed for row in rows for cell in row)
    assert [row[:2] for row in rows] == [[p, e] for p in ("one", "two") for e in ("structured", "mean field")]
    assert {tuple(row[2:]) for row in rows} == {("2.000", "2.00", "2.000", "2.00", "3.0", "0.03")}
    print_estimator_table([make_evaluation("without")])
    assert capsys.readouterr().out == ""


def test_a_rigs_table_and_figure_are_in_its_units():
    newtons = Scales(1e-3, input=20.0, output=0.03, input_unit="N", output_unit="m")
    values = {"input_power": [90.25, 110.25], "input_peak": [19.0, 20.0], "log_posterior_gain": [1.0, 2.0]}
    metrics = {name: np.array(value) for name, value in values.items()}
    evaluation = replace(make_evaluation(systems=2, **metrics), scales=newtons)
    _, rows = comparison_table([evaluation])
    cells = {title: cell.split("\n")[0] for title, cell in rows}
    assert cells["input power / N²"] == "100.2"
    assert cells["input peak / N"] == "19.5"
    u, y, spectrum = plot_inputs_and_outputs([evaluation]).axes
    assert [axes.get_ylabel() for axes in (u, y, spectrum)] == ["u / N", "y / m", "|U| / N"]
    np.testing.assert_allclose(u.lines[0].get_ydata(), 20.0 * evaluation.inputs[:, 0])
    np.testing.assert_allclose(y.lines[0].get_ydata(), 0.03 * evaluation.outputs[:, 0])
    np.testing.assert_allclose(u.lines[0].get_xdata(), np.arange(20))  # ms
    near, far, _ = plot_inputs_and_outputs([replace(evaluation, limits=(0.12, 0.6))]).axes  # signals reach 0.1
    (lines,) = near.collections
    np.testing.assert_allclose([segment[:, 1] for segment in lines.get_segments()], [[-2.4, -2.4], [2.4, 2.4]])
    assert not far.collections
    in_volts = plot_inputs_and_outputs([replace(evaluation, scales=VOLT_SCALES)]).axes[2].lines[0].get_ydata()
    np.testing.assert_allclose(spectrum.lines[0].get_ydata(), 20.0 * 1e-3 * in_volts)


def test_the_best_policy_comes_first(capsys):
    shifts = {"middle": 5.0, "worst": -3.0, "best": 9.0}
    evaluations = [make_evaluation(policy, shift=shift) for policy, shift in shifts.items()]
    head, cells = table_of(capsys, *evaluations)
    assert head == ["best", "middle", "worst"]
    centers = [float(center) for center, _ in cells["log posterior gain / nat"]]
    by_name = {evaluation.policy: summarise_metrics(evaluation) for evaluation in evaluations}
    assert centers == pytest.approx([by_name[policy]["log_posterior_gain"]["mean"] for policy in head], abs=0.005)
    for policy, (center, interval) in zip(head, cells["error of b / %"], strict=True):
        low, high = map(float, interval.strip("[]").split(", "))
        entry = by_name[policy]["error_b"]
        printed = (float(center), low, high)
        assert printed == pytest.approx((100 * entry["median"], 100 * entry["low"], 100 * entry["high"]), abs=0.005)


def test_what_only_some_policies_have_is_a_dash_for_the_others(capsys):
    gain = np.zeros(3)
    with_arrow = make_evaluation("with", log_posterior_gain=gain + 1, arrow_rmse=np.full(3, 0.005))
    _, cells = table_of(capsys, make_evaluation("without", log_posterior_gain=gain), with_arrow)
    assert set(cells) == {"log posterior gain / nat", "RMSE on the real arrow / mV"}
    assert cells["RMSE on the real arrow / mV"] == [("5.00", "[5.00, 5.00]"), ("-", "")]


def test_infinite_intervals_are_printed(capsys):
    metrics = {"log_posterior_gain": np.zeros(3), "arrow_rmse": np.full(3, np.inf)}
    _, cells = table_of(capsys, make_evaluation(**metrics))
    assert cells["RMSE on the real arrow / mV"] == [("inf", "[inf, inf]")]


def test_ten_columns_are_not_cut(capsys):
    policies = [f"runs/ppo-amplitude-v0-{i}" for i in range(10)]
    head, cells = table_of(capsys, *(make_evaluation(policy, shift=-i) for i, policy in enumerate(policies)))
    assert head == policies
    assert all(text.strip("-0123456789.,[] ") == "" for row in cells.values() for cell in row for text in cell)


def test_the_chief_figures_are_a_line_for_each_policy(capsys):
    metrics = {name: np.full(3, value) for name, (value, _, _) in CONSTANTS.items()}
    trained = "runs/ppo-amplitude-v0-12"
    print_headline_table([make_evaluation(trained, **metrics), make_evaluation("prbs", **metrics)], "a title")
    lines = capsys.readouterr().out.splitlines()
    assert max(map(len, lines)) <= 80
    rows = [line.split() for line in lines if line.startswith((trained, "prbs"))]
    cells = ["12.35", "±", "0.00", "87.7", "±", "0.0", "75.0", "0.0", "3.14"]
    assert rows == [[trained, *cells], ["prbs", *cells]]


def load_strictly(path):
    def refuse(constant):
        raise AssertionError(f"{constant} is not JSON")

    return json.loads(path.read_text(), parse_constant=refuse)


def test_json_is_valid_and_complete(tmp_path):
    evaluations = [make_evaluation("one"), make_evaluation("two", seed=1)]
    settings = ComparisonSettings("duffing_env/Amplitude-v0", 30, 0, {"horizon": 20})
    write_evaluations(tmp_path / "made" / "evaluation.json", evaluations, settings)
    written = load_strictly(tmp_path / "made" / "evaluation.json")
    assert set(written) == {"settings", "policies"}
    assert written["settings"] == asdict(settings)
    assert list(written["policies"]) == ["one", "two"]
    for evaluation in evaluations:
        assert written["policies"][evaluation.policy] == {**summarise_metrics(evaluation), "estimators": {}}


def test_json_stays_valid_where_a_figure_is_infinite(tmp_path):
    evaluation = make_evaluation(log_posterior_gain=np.zeros(3), arrow_rmse=np.array([1.0, np.inf, np.inf]))
    write_evaluations(tmp_path / "evaluation.json", [evaluation], ComparisonSettings("Short-v0", 2, 0, {}))
    entry = load_strictly(tmp_path / "evaluation.json")["policies"]["policy"]["arrow_rmse"]
    assert entry == {"median": None, "low": 1.0, "high": None}


def check_picture(path, width, height, colours=1):
    """A PNG of that size [pixel] with that many of the colours of policies."""
    assert path.read_bytes().startswith(b"\x89PNG\r\n\x1a\n")
    picture = np.round(255 * matplotlib.image.imread(path)[:, :, :3]).astype(int)
    assert picture.shape[:2] == (height, width)
    found = set(map(tuple, picture.reshape(-1, 3)))
    lines = [tuple(int(name[i : i + 2], 16) for i in (1, 3, 5)) for name in agents.evaluation.figures._COLOURS]
    assert [line in found for line in lines[:colours]] == [True] * colours
    assert len(found) > 50
    assert np.mean(np.any(picture != 255, axis=2)) > 0.02


def test_compare_writes_what_it_prints(tmp_path, capsys):
    evaluations = compare_policies(
        ["uniform", "prbs"], "duffing_env/Amplitude-v0", 4, {"horizon": 30}, tmp_path / "out", seed=5
    )
    printed = capsys.readouterr().out
    assert "duffing_env/Amplitude-v0, 4 systems" in printed
    folder = tmp_path / "out"
    names = ["contraction.png", "evaluation.json", "excitations.png"]
    assert sorted(path.name for path in folder.iterdir()) == names
    for name in names:
        assert str(folder / name) in printed.splitlines()
    written = load_strictly(folder / "evaluation.json")
    assert written["settings"] == {
        "env": "duffing_env/Amplitude-v0", "systems": 4, "seed": 5, "options": {"horizon": 30},
    }  # fmt: skip
    again = agents.evaluation.policy_evaluation.evaluate_policies(
        ["uniform", "prbs"], systems=4, seed=5, options={"horizon": 30}
    )
    for evaluation, repeated in zip(evaluations, again, strict=True):
        timed = {"estimators": ANY, "decision_time": ANY}
        assert written["policies"][evaluation.policy] == {**summarise_metrics(repeated), **timed}
    check_picture(folder / "contraction.png", 900, 566, colours=2)
    check_picture(folder / "excitations.png", 1440, 480, colours=2)


@table("policies", [1, 10])
def test_contraction_shows_the_quartiles_of_every_policy(policies):
    evaluations = [make_evaluation(str(i), seed=i) for i in range(policies)]
    figure = plot_log_posterior_gain(evaluations, "title")
    (axes,), (legend,) = figure.axes, figure.legends
    assert axes.get_title() == "title"
    assert "nat" in axes.get_ylabel()
    assert [text.get_text() for text in legend.get_texts()] == [str(i) for i in range(policies)]
    for line, band, evaluation in zip(axes.lines, axes.collections, evaluations, strict=True):
        ordered = np.sort(evaluation.gain_curve, axis=1)
        np.testing.assert_array_equal(line.get_xdata(), np.arange(21))
        np.testing.assert_allclose(line.get_ydata(), (ordered[:, 14] + ordered[:, 15]) / 2)
        edges = band.get_paths()[0].vertices[:, 1]
        assert edges.min() == pytest.approx(ordered[:, 7].min() + 0.25 * np.diff(ordered[0, 7:9])[0])
        assert edges.max() == pytest.approx(np.percentile(ordered[-1], 75))


def test_contraction_shows_losses_too():
    gains, losses = (plot_log_posterior_gain([make_evaluation(shift=shift)]).axes[0] for shift in (0.0, -40.0))
    assert gains.get_ylim()[0] == 0.0
    low, high = losses.get_ylim()
    assert low < high
    assert low <= losses.lines[0].get_ydata().min()


@table("policies", [1, 10])
def test_inputs_shows_one_system_under_every_policy_and_the_spectrum_of_all(policies):
    evaluations = [make_evaluation(str(i), seed=i) for i in range(policies)]
    panels = plot_inputs_and_outputs(evaluations).axes
    assert len(panels) == 3 * policies
    for row, evaluation in enumerate(evaluations):
        left, middle, right = panels[3 * row : 3 * row + 3]
        for axes, signal, label in ((left, evaluation.inputs, "u / V"), (middle, evaluation.outputs, "y / V")):
            (line,) = axes.lines
            np.testing.assert_array_equal(line.get_ydata(), signal[:, 0])
            np.testing.assert_allclose(line.get_xdata(), 1e3 * SILVERBOX_SAMPLING_STEP * np.arange(20))
            assert axes.get_ylabel() == label
        assert left.get_title(loc="left") == evaluation.policy
        frequencies, sizes = right.lines[0].get_data()
        tones = np.exp(-2j * np.pi * SILVERBOX_SAMPLING_STEP * np.outer(frequencies, np.arange(20)))
        power = np.mean(np.abs(tones @ evaluation.inputs / 20) ** 2, axis=1)
        np.testing.assert_allclose(sizes, 1e3 * np.sqrt(power))
        assert frequencies[-1] == pytest.approx(0.5 / SILVERBOX_SAMPLING_STEP)


@table("updates", [1, 2, 30])
def test_learning_curve_shows_returns_over_samples(updates):
    curve = [(4096 * (i + 1), 0.5 * i + 0.1, np.nan if i == 0 else float(i)) for i in range(updates)]
    axes = plot_learning_curve(curve, "information_gain").axes[0]
    np.testing.assert_allclose(axes.lines[0].get_xdata(), 4096e-6 * np.arange(1, updates + 1))
    np.testing.assert_array_equal(axes.lines[0].get_ydata(), [point[2] for point in curve])
    assert axes.get_ylabel() == "mean return: information gain"


def test_pictures_are_written(tmp_path):
    curve = [(4096 * (i + 1), 0.5 * i + 0.1, float(i)) for i in range(9)]
    save_png(plot_learning_curve(curve, "information_gain"), tmp_path / "curve.png")
    check_picture(tmp_path / "curve.png", 840, 480)
    evaluations = [make_evaluation(str(i), seed=i, shift=3.0 * i) for i in range(4)]
    save_png(plot_log_posterior_gain(evaluations, "title"), tmp_path / "contraction.png")
    check_picture(tmp_path / "contraction.png", 900, 592, colours=4)  # two lines of names
    save_png(plot_inputs_and_outputs(evaluations), tmp_path / "excitations.png")
    check_picture(tmp_path / "excitations.png", 1440, 864, colours=4)
