"""The documents' examples run, and what they point to is there."""

import doctest
import importlib
import re
import sys
import tomllib
from pathlib import Path

import pytest
from tables import table

ROOT = Path(__file__).parents[1]
WITH_EXAMPLES = ["README.md"]
WITH_EXAMPLES += [f"docs/{name}.md" for name in ("environments", "estimators", "extending", "own_data", "own_model")]
WITH_EXAMPLES += ["docs/running.md", "docs/rig_electronic_duffing.md", "docs/rig_beam.md"]
#: Package to its modules with examples.
MODULES = {
    package: [
        ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")
        for path in sorted((ROOT / package).rglob("*.py"))
        if re.search(r"^ +>>> ", path.read_text(encoding="utf-8"), re.MULTILINE)
    ]
    for package in ("agents", "benchmarks", "duffing_env", "estimator")
}
DOCUMENTS = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
TEN_MINUTES = ROOT / "docs" / "ten_minutes.md"


@pytest.fixture
def desk(tmp_path, monkeypatch):
    """An empty folder to work in, with the record that the README simulates."""
    (block,) = re.findall(r"```python\n(import numpy.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "100")
    exec(compile(block, "README.md", "exec"), {})
    assert Path("record.csv").exists()
    return tmp_path


class NearEnough(doctest.OutputChecker):
    """Numbers may differ by 2 % of the largest in their line: a fit ends within a fraction of a standard deviation."""

    NUMBER = re.compile(r"(?<![\w.])-?\d+(?:\.\d+)?(?:e[+-]?\d+)?(?![\w])")

    def check_output(self, want, got, optionflags):
        if super().check_output(want, got, optionflags):
            return True
        pairs = list(zip(self.lines(want), self.lines(got), strict=False))
        return len(self.lines(want)) == len(self.lines(got)) and all(self.near(*pair) for pair in pairs)

    def lines(self, text):
        return [" ".join(line.split()) for line in text.splitlines() if line.strip(" ─")]

    def near(self, want, got):
        one, other = ([float(word) for word in self.NUMBER.findall(line)] for line in (want, got))
        if self.NUMBER.sub("#", want) != self.NUMBER.sub("#", got) or len(one) != len(other):
            return False
        return all(abs(a - b) <= 0.02 * max(map(abs, one)) for a, b in zip(one, other, strict=True))


@pytest.mark.parametrize("document", WITH_EXAMPLES)
def test_examples_run(document, desk):
    text = (ROOT / document).read_text()
    runner = doctest.DocTestRunner(NearEnough(), verbose=False)
    failures, examples = runner.run(doctest.DocTestParser().get_doctest(text, {}, document, document, 0))
    assert examples > 2
    assert failures == 0


def test_the_silverbox_s_rig_gives_what_is_printed(record, capsys):
    block, answer = re.findall(r"```(?:python)?\n(.*?)```", (ROOT / "docs/rig_silverbox.md").read_text(), re.DOTALL)
    exec(compile(block, "rig_silverbox.md", "exec"), {})
    assert NearEnough().check_output(answer, capsys.readouterr().out, 0)


WITH_COMMANDS = [path for path in DOCUMENTS if "```console" in path.read_text() and path != TEN_MINUTES]


@pytest.mark.parametrize("document", WITH_COMMANDS, ids=lambda path: path.name)
def test_commands_answer_as_shown(document, desk, monkeypatch, capsys):
    sessions = re.findall(r"```console\n(.*?)```", document.read_text(), re.DOTALL)
    turns = [turn for session in sessions for turn in turns_of(session)]
    assert turns
    for command, answer in turns:
        printed = printed_by(command, monkeypatch, capsys)
        assert NearEnough().check_output(answer, printed, 0), f"{command}: {printed}"


def turns_of(session):
    """Commands of a session, each with its answer."""
    return [turn.split("\n", 1) for turn in session.split("$ ")[1:]]


def printed_by(command, monkeypatch, capsys):
    from agents.commands import main

    name, *words = command.split()
    assert name == "duffing-env"
    monkeypatch.setattr(sys, "argv", [name, *words])
    main()
    return capsys.readouterr().out


def test_the_ten_minutes_lead_to_the_next_experiment(tmp_path, monkeypatch, capsys):
    """The page from top to bottom, in an empty folder: its script, its rig file, its commands, in their order."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "80")
    page = TEN_MINUTES.read_text()
    (script,) = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    (rig,) = re.findall(r"```toml\n(.*?)```", page, re.DOTALL)

    def bench(*words):
        monkeypatch.setattr(sys, "argv", ["bench.py", *words])
        exec(compile(script, "bench.py", "exec"), {})

    assert "`python bench.py first.csv`" in page
    assert "    python bench.py next.csv answer.csv\n" in page
    bench("first.csv")
    sessions = re.findall(r"```console\n(.*?)```", page, re.DOTALL)
    (init, identify, design, again) = [turn for session in sessions for turn in turns_of(session)]
    assert NearEnough().check_output(init[1], printed_by(init[0], monkeypatch, capsys), 0)
    written = tomllib.loads(Path("rig.toml").read_text())
    Path("rig.toml").write_text(rig)
    described = tomllib.loads(rig)
    assert (described["input"].pop("limit"), described["output"].pop("range")) == (10.0, 0.02)
    assert described == written
    printed = printed_by(identify[0], monkeypatch, capsys)
    assert NearEnough().check_output(identify[1], printed, 0), printed
    # Which of several good plans is found hangs on the last bits: the words are compared, and the interval of b.
    printed = printed_by(design[0], monkeypatch, capsys)
    assert words_of(printed) == words_of(design[1]), printed
    bench("next.csv", "answer.csv")
    printed = printed_by(again[0], monkeypatch, capsys)
    assert words_of(printed) == words_of(again[1]), printed
    first, both = (interval_of("b", text) for text in (identify[1], printed))
    assert both[1] - both[0] < 0.1 * (first[1] - first[0])
    assert both[0] < 4e7 < both[1]


def words_of(text):
    return re.findall(r"[^\W\d]{2,}", NearEnough.NUMBER.sub("", text))


def interval_of(name, table_printed):
    """The ends of a parameter's interval in the table of `identify`."""
    (ends,) = re.findall(rf"^ *{name} +\S+ +(\S+) to (\S+)", table_printed, re.MULTILINE)
    return tuple(map(float, ends))


@table(("want", "got", "near"), [
    ("m = 0.40001 kg, 90 % in [0.39, 0.41]", "m = 0.40012 kg, 90 % in [0.39, 0.41]", True),
    ("  m    0.4   0.39 to 0.41    kg", "m 0.4   0.39 to 0.41 kg  ", True),
    ("m = 0.4 kg", "m = 0.42 kg", False),
    ("m = 0.4 kg", "c = 0.4 kg", False),
    ("y0 -2.06e-08 -3.5e-07 to 3.1e-07 m", "y0 -1.9e-08 -3.5e-07 to 3.1e-07 m", True),
    ("y0 -2.06e-08 -3.5e-07 to 3.1e-07 m", "y0 2.06e-05 -3.5e-07 to 3.1e-07 m", False),
    ("True", "False", False),
])  # fmt: skip
def test_numbers_that_are_near_enough(want, got, near):
    assert NearEnough().check_output(want, got, 0) == near


def test_every_check_is_explained():
    from estimator.identification.diagnostics import equation_checks, guess_checks

    source = "".join(path.read_text() for path in Path(guess_checks.__file__).parent.glob("*.py"))
    names = (
        set(re.findall(r'Finding\("(\w+)"', source))
        | set(equation_checks._TERM_DESCRIPTIONS)
        | {"delay", "interpolation"}
    )
    names |= {slip.check_name for slip in (*guess_checks._CALIBRATION_ERRORS, *guess_checks._STEP_ERRORS.values())}
    assert len(names) > 10
    explained = re.findall(r"^\| `(\w+)` \|", (ROOT / "docs" / "checks.md").read_text(), re.MULTILINE)
    assert set(explained) == names


@pytest.mark.parametrize("package", MODULES)
def test_examples_of_the_docstrings_run(package, subtests, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for module in MODULES[package]:
        with subtests.test(module):
            failures, examples = doctest.testmod(importlib.import_module(module))
            assert examples > 0
            assert failures == 0


@table("document", DOCUMENTS)
def test_links_lead_somewhere(document):
    for target in re.findall(r"\]\(([^)#]+)\)", document.read_text()):
        if "://" not in target:
            assert (document.parent / target).exists(), f"{document.name} points to {target}, which is not there"


def test_the_user_s_part_of_the_manual_is_short():
    """Pages that are no evidence hold at most 130 kB in all."""
    assert sum(path.stat().st_size for path in (ROOT / "docs").glob("*.md")) <= 130_000


def test_nothing_else_stands_at_the_top():
    import subprocess

    listed = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True)
    if listed.returncode:
        pytest.skip("not a git checkout")
    top = {line.split("/")[0] for line in listed.stdout.splitlines()}
    expected = {"estimator", "duffing_env", "agents", "research", "tests", "benchmarks", "docs", "examples"}
    expected |= {"train.py", "evaluate.py", "reproduce.py", "pyproject.toml", "requirements.lock", "Makefile"}
    expected |= {"README.md", "CHANGELOG.md", "CONTRIBUTING.md", "LICENSE", "CITATION.cff", "SECURITY.md"}
    assert {name for name in top if not name.startswith(".")} <= expected
