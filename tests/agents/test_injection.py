"""Names are names: of policies, rigs, channels and files, in pages, tables, figures, CSV, TOML and messages."""

import csv
import json
import tomllib
import warnings
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pytest
import tables

from agents.cli import one_line_errors
from agents.commands import main
from agents.commands.identify_command import print_identification as show_identified
from agents.commands.rig_file_builder import rig_text_from_record
from agents.console_output import format_table, print_texts_and_tables
from agents.evaluation.comparison_tables import ComparisonSettings, print_comparison_table
from agents.evaluation.figures import plot_inputs_and_outputs, plot_log_posterior_gain, save_png
from agents.evaluation.html_report import write_html_report
from agents.evaluation.policy_evaluation import evaluate_policies
from agents.hardware.next_experiment import design_experiment
from agents.leaderboard import leaderboard_file
from agents.training.algorithms import ALGORITHMS
from agents.training.hyperparameters import write_hyperparameters
from estimator import Rig, identify
from estimator.support.progress import _terminal_bar, show_progress

NAMES = [
    "<script>alert(1)</script>", "\"><img src=x onerror='alert(1)'>", "&lt;b&gt;", "=cmd|' /C calc'!A0", "+1+1", "-2",
    "@SUM(1)", "\t=1", '"quoted"', "two\nlines", "two\r\nlines", "# no comment", "$\\frac{$", "$x$", "\\textbf{b}",
    "\x1b]0;title\x07", "\x1b[2J", "\x9b31m", "\u202ereversed", "\x7f", "[bold]", "[/]", "[link=file:///x]y[/link]",
    ":warning:", "_hidden", "n" * 300, "$" * 300,
]  # fmt: skip
RIG = {
    "step": 1e-3, "input": {"unit": "N", "limit": 6.0}, "output": {"unit": "m", "range": 0.03, "noise": 5e-6},
    "guess": {"m": (0.3, 0.5), "c": (0.4, 0.8), "a": (2e3, 3e3), "b": (2e7, 6e7)},
}  # fmt: skip
#: For slow tests: all special characters at once, and a name that is too long for its place.
SHARP = ["<img src=x onerror=1>\x1b[2J\n[/]$\\frac{$\u202e'", "=cmd|' '!A0", "_hidden", "n" * 300, "$" * 300]
names = tables.table("name", NAMES)


def is_tame(text):
    """Whether a terminal would only show it."""
    return all(letter.isprintable() or letter == "\n" for letter in text)


class Elements(HTMLParser):
    """What a browser would make: names of elements and attributes, and the text."""

    def __init__(self, page):
        super().__init__()
        self.found, self.text = set(), ""
        self.feed(page)

    def handle_starttag(self, tag, attributes):
        self.found |= {tag, *(name for name, _ in attributes if name.startswith("on"))}

    def handle_data(self, data):
        self.text += data


@pytest.fixture(scope="module")
def evaluation():
    return evaluate_policies(["uniform"], systems=4, options={"horizon": 8})[0]


def test_policies_in_pages_and_figures(evaluation, tmp_path):
    named = [replace(evaluation, policy=name) for name in SHARP]
    settings = ComparisonSettings("duffing_env/Amplitude-v0", 4, 0, {"own": SHARP})
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # of layouts that have no room
        write_html_report(tmp_path / "report.html", named, settings, ["evaluate.py", *SHARP])
        for figure in (plot_log_posterior_gain(named), plot_inputs_and_outputs(named)):
            save_png(figure, tmp_path / "figure.png")
        (legend,) = plot_log_posterior_gain(named).legends
    assert len(legend.get_texts()) == len(SHARP)
    page = Elements((tmp_path / "report.html").read_text())
    assert not page.found & {"script", "img", "b", "onerror"}
    assert all(one.title in page.text for one in named)


sharp = pytest.mark.parametrize("name", SHARP, ids=lambda name: ascii(name[:24]))


@names
def test_a_policy_in_tables(name, evaluation, capsys):
    named, other = replace(evaluation, policy=name), replace(evaluation, policy="other")
    print_comparison_table([named, other], "title")
    print_texts_and_tables(format_table(["name"], [[name]]), name)
    printed = capsys.readouterr().out
    assert is_tame(printed)
    if len(name) < 20:
        assert printed.count(named.title) >= (1 if "\n" in name else 2)  # cells keep their lines


@names
def test_a_name_on_a_board(name, tmp_path, monkeypatch, capsys):
    (first, *_) = [json.loads(line) for line in leaderboard_file.SHIPPED_LEADERBOARD.read_text().splitlines()][-1:]
    leaderboard_file.append_entry(tmp_path / "board.jsonl", first | {"name": name, "track": f"duffing_env/{name}"})
    assert len((tmp_path / "board.jsonl").read_text().splitlines()) == 1
    main(["report", "--board", str(tmp_path / "board.jsonl"), "--output", str(tmp_path / "board.html")])
    assert is_tame(capsys.readouterr().out)
    assert not Elements((tmp_path / "board.html").read_text()).found & {"script", "img", "b", "onerror"}


@names
def test_an_error_is_one_line(name, capsys):
    with pytest.raises(SystemExit) as ended, one_line_errors("duffing-env"):
        raise ValueError(f"rig must be a file, but is {name}")
    assert ended.value.code == 2
    messages = capsys.readouterr().err
    assert len(messages.splitlines()) == 1
    assert is_tame(messages)
    # Words that no option takes are repeated as they were typed: by tyro, not here.
    for words in (["identify", name, "none.csv"], ["evaluate", "--policies", name], ["export", name, "--output", "x"],
                  ["report", "--board", name]):  # fmt: skip
        with pytest.raises(SystemExit) as ended:
            main(words)
        assert ended.value.code == 2
        assert is_tame(capsys.readouterr().err)


@names
def test_a_name_in_a_progress_line(name, capsys, monkeypatch):
    monkeypatch.setattr("estimator.support.progress.REPORT_INTERVAL", 0.0)
    with show_progress("Evaluating") as tell:
        tell(0.5, name)
    said = capsys.readouterr().err
    assert is_tame(said)
    assert len(said.splitlines()) == 1 + said.startswith("\n")  # where a line was begun before
    with _terminal_bar() as show_bar:
        show_bar(0.5, name)


@sharp
def test_a_channel_name(name, tmp_path):
    """A unit stands in the heads of CSV files, in comments of rig files, in pages and figures."""
    described = RIG | {"input": {"unit": name[:40].replace("\n", "").replace("[", "("), "limit": 6.0}}
    if not is_tame(name):
        with pytest.raises(ValueError, match="unit must hold no control codes"):
            Rig.from_dict(described)
        described["input"]["unit"] = "<b onerror=1>$\\frac{$"
    rig = Rig.from_dict(described)
    rig.save(tmp_path / "rig.toml")
    assert Rig.from_file(tmp_path / "rig.toml") == rig
    design_experiment(rig, policy="prbs", samples=16).write(tmp_path / "next.csv")
    head, *rows = csv.reader((tmp_path / "next.csv").read_text().splitlines())
    assert head == ["time [s]", f"u [{rig.input.unit}]"]
    assert {len(row) for row in rows} == {2}
    result = identify(rig, record(tmp_path / "record.csv"))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        result.report(tmp_path / "page.html", [name])
    assert not Elements((tmp_path / "page.html").read_text()).found & {"script", "img", "onerror"}


def record(path):
    """A short record of an oscillator."""
    rng, y, v = np.random.default_rng(0), np.zeros(256), 0.0
    u = 6.0 * np.repeat(rng.choice([-1.0, 1.0], 32), 8)
    for k in range(255):
        x = y[k]
        for _ in range(50):
            v += 2e-5 / 0.4 * (u[k] - 0.6 * v - 2500.0 * x - 4e7 * x**3)
            x += 2e-5 * v
        y[k + 1] = x
    y += 5e-6 * rng.standard_normal(256)
    rows = np.column_stack([1e-3 * np.arange(256), u, y])
    np.savetxt(path, rows, delimiter=",", header="time [s],u,y", comments="")
    return path


@sharp
def test_a_file_name(name, tmp_path, capsys):
    """Of a record: in the rig file made from it, in the page, and in what is printed."""
    if "/" in name or len(name) > 200:
        name = name.replace("/", ":")[:200]
    path = record(tmp_path / f"{name}.csv")
    text, said = rig_text_from_record(path)
    assert is_tame(said)
    assert tomllib.loads(text).keys() == {"step", "interpolation", "delay", "input", "output"}
    assert is_tame(text)
    result = identify(Rig.from_dict(RIG), [path])
    result.report(tmp_path / "page.html", [f"duffing-env identify {path}"])
    assert not Elements((tmp_path / "page.html").read_text()).found & {"script", "img", "onerror"}
    show_identified(result)
    assert is_tame(capsys.readouterr().out)
    write_hyperparameters(tmp_path / "best.toml", "duffing_env/Short-v0", ALGORITHMS["ppo"](), f"trial 3 of {path}")
    (found,) = tomllib.loads((tmp_path / "best.toml").read_text()).values()
    assert "learning_rate" in found
