"""``duffing-env``, as a user meets it."""

import json
import os
import signal
import subprocess
import sys
import tomllib
from pathlib import Path

import numpy as np
import pytest
from tables import table

from agents.commands import main
from estimator import Rig
from estimator.rigs.rig import SHIPPED_RIGS

ROOT = Path(__file__).parents[2]
TRUTH = {"m": 0.4, "c": 0.6, "a": 2500.0, "b": 4e7}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder with a record: a mass of 0.4 kg on a hardening spring, by small explicit steps."""
    place = tmp_path_factory.mktemp("bench")
    rng = np.random.default_rng(0)
    u = 6.0 * np.repeat(rng.choice([-1.0, 1.0], 128), 8)
    y, v = np.zeros(1024), 0.0
    for k in range(1023):
        x = y[k]
        for _ in range(50):
            v += 2e-5 / 0.4 * (u[k] - 0.6 * v - 2500.0 * x - 4e7 * x**3)
            x += 2e-5 * v
        y[k + 1] = x
    y += 5e-6 * rng.standard_normal(1024)
    rows = np.column_stack([np.arange(1024.0), u, 1e3 * y])
    head = "time [ms],force [N],displacement [mm]"
    np.savetxt(place / "record.csv", rows, delimiter=",", header=head, comments="", fmt="%.9g")
    return place


@pytest.fixture
def run(monkeypatch, capsys):
    """Runs a command as the shell would, but within this process: returns status, output and messages."""
    monkeypatch.setenv("COLUMNS", "100")

    def command(*words, answers=None):
        if answers is not None:
            given = iter(answers)

            def answer(question=""):
                try:
                    return next(given)
                except StopIteration:
                    raise EOFError from None

            monkeypatch.setattr("builtins.input", answer)
        monkeypatch.setattr(sys, "argv", ["duffing-env", *map(str, words)])
        status = 0
        try:
            main()
        except SystemExit as stop:
            status = stop.code
        return status, *capsys.readouterr()

    return command


def test_from_a_record_to_its_parameters(run, folder, monkeypatch):
    monkeypatch.chdir(folder)
    status, printed, _ = run("rig", "init", "rig.toml", "--from", "record.csv")
    assert status == 0
    assert "The sampling step is 0.001 s (1000 Hz), by the times in time [ms]." in printed
    assert "The output is in mm, and converted to m" in printed
    rig = Rig.from_file("rig.toml")
    assert (rig.step, rig.input.unit, rig.output.unit, rig.output.kind) == (1e-3, "N", "m", "displacement")
    status, printed, _ = run("identify", "rig.toml", "record.csv", "--report", "out/page.html")
    assert status == 0
    (row,) = [line.split() for line in printed.splitlines() if line.split()[:1] == ["m"] and " to " in line]
    assert float(row[1]) == pytest.approx(0.4, rel=0.01)
    assert row[-1] == "kg"
    assert "The sampling step is 0.001 s (1000 Hz) by the rig, and the times agree." in printed
    assert "No check speaks against this result." in printed
    page = Path("out/page.html").read_text()
    assert "duffing-env identify rig.toml record.csv --report out/page.html" in page
    lines = Path("record.csv").read_text().splitlines()
    Path("first.csv").write_text("\n".join(lines[:600]))
    Path("second.csv").write_text("\n".join([lines[0], *lines[600:]]))
    status, printed, _ = run("identify", "rig.toml", "first.csv", "second.csv", "--json")
    assert status == 0
    described = json.loads(printed)
    assert [one["samples"] for one in described["records"]] == [599, 425]
    for name, truth in TRUTH.items():
        found = described["parameters"][name]
        assert found["mean"] == pytest.approx(truth, rel=0.01)
        assert found["low"] < found["mean"] < found["high"]
    assert described["warnings"] == []
    assert Rig.from_dict(described["rig"]) == rig


def test_columns_of_any_name_are_named_once(run, folder, monkeypatch):
    monkeypatch.chdir(folder)
    _, *lines = Path("record.csv").read_text().splitlines()
    Path("channels.csv").write_text("\n".join(["Zeit [ms],CH1 [N],CH2 [mm]", *lines]))
    status, printed, _ = run("rig", "init", "unit.toml", "--from", "channels.csv")
    assert status == 0
    assert "Input: CH1 [N]; output: CH2 [mm], a displacement (by their units)." in printed
    taken = Rig.from_file("unit.toml")
    assert (taken.input.column, taken.output.column) == ("CH1 [N]", "CH2 [mm]")
    Path("daten.csv").write_text("\n".join(["Zeit [ms],Kraft [N],Weg [mm]", *lines]))
    status, printed, _ = run("rig", "init", "name.toml", "--from", "daten.csv")
    assert status == 0
    assert "Input: Kraft [N]; output: Weg [mm], a displacement (by their names)." in printed
    taken = Rig.from_file("name.toml")
    assert (taken.input.column, taken.output.column) == (None, None)
    Path("four.csv").write_text("\n".join(["Zeit [ms],CH1 [V],CH2 [V],CH3 [A]", *(f"{one},0" for one in lines)]))
    status, _, printed = run("rig", "init", "hart.toml", "--from", "four.csv")
    assert status == 2
    assert "name both by --input and --output of duffing-env rig init" in printed
    assert run("rig", "init", "hart.toml", "--from", "daten.csv", "--input", "Kraft", "--output", "Weg")[0] == 0
    rig = Rig.from_file("hart.toml")
    assert (rig.input.column, rig.output.column, rig.output.unit) == ("Kraft", "Weg", "m")
    status, printed, _ = run("identify", "hart.toml", "daten.csv", "--json")
    assert json.loads(printed)["parameters"]["m"]["mean"] == pytest.approx(0.4, rel=0.01)


def test_warnings_are_printed(run, folder, monkeypatch):
    monkeypatch.chdir(folder)
    Path("late.toml").write_text('step = 1e-3\ndelay = 1\n[input]\nunit = "N"\n[output]\nunit = "mm"\n')
    status, printed, _ = run("identify", "late.toml", "record.csv")
    assert status == 0
    assert "delay: " in printed
    assert "No check speaks" not in printed


@table(
    ("words", "message"),
    [
        (
            ["identify", "none.toml", "record.csv"],
            "there is no none.toml; write it by hand, or by duffing-env rig init",
        ),
        (["identify", "rig.toml", "none.csv"], "there is no none.csv"),
        (["identify", "rig.toml"], "data must name at least one CSV or MAT file"),
        (["identify", "record.csv"], "is record.csv; write one: duffing-env rig init --from record.csv"),
        (["identify", "bad.toml", "record.csv"], "did you mean 'step'?"),
        (["rig", "init", "rig.toml"], "there is rig.toml; name another, or add --force"),
        (["rig", "init", "new.toml", "--from", "bem"], "there is no bem"),
        (["rig", "init", "new.toml", "--from", "plain.csv"], "add --step SECONDS"),
        (["rig", "init", "new.toml", "--from", "fortnights.csv"], "the unit of the times must be one of s, ms"),
        (["rig", "init", "new.toml", "--from", "r.mat"], "r.mat must be a CSV file to have a step, but is a MAT file"),
        (["rig", "init", "new.toml", "--from", "r.mat", "--step", "1"], "r.mat must be a sound MAT file"),
        (
            ["rig", "init", "new.toml", "--from", "kind.csv"],
            "the unit of 'displacement [m/s]' must fit its name, a displacement, but is the unit of a velocity",
        ),
        (["rig", "init", "new.toml", "--step", "1"], "step goes with a record"),
        (["rig", "init", "new.toml", "--from", "plain.csv", "--step", "-1"], "step must be a number from 1e-30"),
    ],
)
def test_a_user_s_error_is_one_line_and_exit_status_2(run, tmp_path, monkeypatch, words, message):
    monkeypatch.chdir(tmp_path)
    Path("rig.toml").write_text("step = 1e-3")
    Path("bad.toml").write_text("stepp = 1e-3")
    Path("record.csv").write_text("u,y\n" + "1,2\n" * 10)
    Path("plain.csv").write_text("u,y\n1,2\n2,3\n")
    Path("kind.csv").write_text("t,u,displacement [m/s]\n0,1,2\n1,1,2\n2,2,3\n")
    Path("r.mat").write_bytes(b"none")
    Path("fortnights.csv").write_text("t [fortnight],u,y\n0,1,2\n1,1,2\n2,2,3\n")
    status, printed, messages = run(*words)
    assert (status, printed) == (2, "")
    (line,) = messages.splitlines()
    assert line.startswith("duffing-env: ")
    assert message in line
    assert not Path("new.toml").exists()


@table(
    ("head", "step", "units", "kind"),
    [
        ("time [ms],force [N],displacement [mm]", 1.6384e-3, ("N", "m"), "displacement"),
        ("t (ms),u (V),v (V)", 1.6384e-3, ("V", "V"), "velocity"),
        ("time [ms],drive [V],response [m/s^2]", 1.6384e-3, ("V", "m/s²"), "acceleration"),
        ("ACC (g),F (N),t (ms)", 1.6384e-3, ("N", "m/s²"), "acceleration"),
        ("time,input,output", 1.6384, ("1", "1"), "displacement"),
        ("time,input,response [deg]", 1.6384, ("1", "rad"), "displacement"),
    ],
)
def test_a_rig_takes_step_and_units_from_a_record(run, tmp_path, monkeypatch, head, step, units, kind):
    monkeypatch.chdir(tmp_path)
    fields = [(f"{1.6384 * k:.6f}", f"{k % 3}", f"{k % 5}") for k in range(2000)]
    rows = [",".join(row if head.startswith("t") else row[::-1]) for row in fields]
    Path("r.csv").write_text("\n".join([head, *rows]))
    status, printed, _ = run("rig", "init", "--from", "r.csv")
    assert status == 0
    assert "Next: duffing-env identify rig.toml r.csv" in printed
    rig = Rig.from_file("rig.toml")
    assert rig == Rig(rig.step, input={"unit": units[0]}, output={"unit": units[1], "kind": kind})
    assert ("just before the input changes" in Path("rig.toml").read_text()) == (kind == "acceleration")
    assert rig.step == pytest.approx(step, rel=1e-6)


def test_a_step_can_be_given(run, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("a record.csv").write_text("1 2\n2 3\n3 4\n")
    status, printed, _ = run("rig", "init", "--from", "a record.csv", "--step", "2e-6")
    assert status == 0
    assert "Next: duffing-env identify rig.toml 'a record.csv'" in printed
    assert Rig.from_file("rig.toml") == Rig(2e-6)


def test_a_mat_file_can_be_the_record(run, tmp_path, monkeypatch):
    from scipy.io import savemat

    monkeypatch.chdir(tmp_path)
    savemat("r.mat", {"u": np.arange(9.0), "y": np.arange(9.0) ** 2})
    status, printed, _ = run("rig", "init", "--from", "r.mat", "--step", "2e-3")
    assert status == 0
    assert "Next: duffing-env identify rig.toml r.mat" in printed
    assert Rig.from_file("rig.toml") == Rig(2e-3)


def test_a_rig_is_made_from_answers(run, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    answers = ["fast", "-3", "500 Hz", "stairs", "linear", "mN", "20", "speed", "velocity", "mm/s", "", "-1 2", "2 1",
               "0.3 0.5", "0.1, 2", "1e3 5e3", "-1e8 1e8"]  # fmt: skip
    status, printed, _ = run("rig", "init", answers=answers)
    assert status == 0
    assert [line.strip() for line in printed.splitlines() if line.startswith("  ")] == [
        "must be a number, but is 'fast'",
        "must be positive, but is -3",
        "must be one of zero_order, linear, look_ahead, spline, but is stairs",
        "must be one of displacement, velocity, acceleration, but is speed",
        "must be positive, but begins at -1",
        "must be two numbers, the lower one first, but is 2 1",
    ]
    assert Rig.from_file("rig.toml") == Rig(
        2e-3,
        "linear",
        input={"unit": "mN", "limit": 20},
        output={"unit": "mm/s", "kind": "velocity"},
        guess={"m": (0.3, 0.5), "c": (0.1, 2), "a": (1e3, 5e3), "b": (-1e8, 1e8)},
    )
    text = Path("rig.toml").read_text()
    assert "[mN" not in text.split("[guess]")[0]
    assert "# mN/mm³" in text
    status, _, messages = run("rig", "init", "other.toml", answers=["1e-3"])
    assert (status, len(messages.splitlines())) == (2, 1)
    assert "nobody answers" in messages
    assert not Path("other.toml").exists()


@pytest.mark.parametrize("name", SHIPPED_RIGS)
def test_a_rig_that_ships_is_listed_and_copied(run, tmp_path, monkeypatch, name):
    monkeypatch.chdir(tmp_path)
    assert name in run("rig", "list")[1].split()
    Path("rig.toml").write_text("step = 1")
    assert run("rig", "init", "rig.toml", "--from", name, "--force")[0] == 0
    assert Rig.from_file("rig.toml") == Rig.shipped(name) == Rig.from_any(name)
    assert tomllib.loads(Path("rig.toml").read_text())["step"] == Rig.shipped(name).step


def test_help_has_examples_on_lines_of_their_own_and_names_every_argument(run):
    status, printed, _ = run("--help")
    assert status == 0
    assert "identify" in printed
    assert "rig" in printed
    for words, arguments in (
        (["identify"], ["RIG", "DATA", "--report PATH", "--json"]),
        (["rig", "init"], ["--from DATA|NAME", "--step SECONDS", "--force"]),
        (["rig", "list"], []),
    ):
        status, printed, _ = run(*words, "--help")
        assert status == 0
        lines = [line.strip() for line in printed.splitlines()]
        assert any(line.startswith(f"$ duffing-env {' '.join(words)}") for line in lines)
        assert all(line.count("duffing-env ") <= 1 for line in lines)
        assert all(argument in printed for argument in arguments)


@pytest.mark.parametrize("columns", ["80", "300"])
def test_no_line_of_a_help_is_wider_than_80_characters(run, monkeypatch, subtests, columns):
    monkeypatch.setenv("COLUMNS", columns)
    commands = ("identify", "design", "run", "train", "evaluate", "export", "report", "rig", "rig init", "rig list")
    for words in ("", *commands):
        with subtests.test(words):
            status, printed, _ = run(*words.split(), "--help")
            assert status == 0
            assert max(map(len, printed.splitlines())) <= 80


def test_no_line_of_a_table_is_wider_than_80_characters(run, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for words in (["report"], ["rig", "list"]):
        printed = run(*words)[1]
        assert max(map(len, printed.splitlines())) <= 80


@pytest.mark.skipif(os.name == "nt", reason="no such signal")
@pytest.mark.parametrize(("number", "status"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_signal_is_one_line_and_its_exit_status(tmp_path, number, status):
    # A process that was started in the background ignores the signal.
    code = "import signal; signal.signal(signal.SIGINT, signal.default_int_handler)\n"
    code += "from agents.commands import main; main(['rig', 'init'])"
    environment = os.environ | {"PYTHONPATH": str(ROOT), "PYTHONUNBUFFERED": "1"}
    asking = subprocess.Popen(
        [sys.executable, "-c", code],
        cwd=tmp_path, env=environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    assert asking.stdout is not None
    assert "Ctrl-C" in asking.stdout.readline()
    asking.send_signal(number)
    _, messages = asking.communicate(timeout=600)
    assert asking.returncode == status
    assert messages.strip() == "duffing-env: stopped"
    assert list(tmp_path.iterdir()) == []


def test_what_can_be_left_out_stands_in_brackets(run):
    _, printed, _ = run("design", "--help")
    assert "RIG [POSTERIOR]" in printed
