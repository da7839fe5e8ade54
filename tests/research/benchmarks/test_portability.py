"""The run under other instruction sets: what it chooses, and that it does not hide a failure."""

import os

import pytest

from benchmarks import portability
from benchmarks.portability import ROOT, Config, Outcome, Setting, main, read_report, run, settings

REPORT = """<testsuites><testsuite tests="4">
<testcase classname="tests.a" name="passes"/>
<testcase classname="tests.a" name="fails"><failure message="no"/></testcase>
<testcase classname="tests.b" name="breaks"><error message="no"/></testcase>
<testcase classname="tests.b" name="skips"><skipped message="no"/></testcase>
</testsuite></testsuites>"""


def test_a_report_is_counted(tmp_path):
    (tmp_path / "report.xml").write_text(REPORT)
    assert read_report(tmp_path / "report.xml", 3.0) == Outcome(1, ("tests.a::fails", "tests.b::breaks"), 3.0)


def test_every_part_is_there_and_every_setting_has_a_name_of_its_own():
    found = list(settings())
    assert all((ROOT / path).exists() for setting in found for path in setting.part)
    names = [setting.name for setting in found]
    assert len(set(names)) == len(names)


def test_a_setting_reaches_the_tests(tmp_path):
    (tmp_path / "test_it.py").write_text(
        "import os\n"
        "def test_set(): assert os.environ['A_SETTING'] == 'yes'\n"
        "def test_cache(): assert os.environ['NUMBA_CACHE_DIR'].endswith('host')\n"
        "def test_fails(): assert os.environ['A_SETTING'] == 'no'\n"
    )
    outcome = run(Setting("mine", (str(tmp_path),), {"A_SETTING": "yes"}), 1, tmp_path)
    assert (outcome.passed, [name.split("::")[1] for name in outcome.failed]) == (2, ["test_fails"])
    assert "A_SETTING" not in os.environ


@pytest.mark.slow  # another pytest
def test_tests_that_cannot_run_do_not_pass(tmp_path):
    with pytest.raises(OSError, match=r"the tests did not (run|end) under 'mine'"):
        run(Setting("mine", (str(tmp_path / "nothing"),)), 1, tmp_path)


@pytest.fixture
def two_settings(monkeypatch):
    found = [Setting("plain", ()), Setting("future", (), needs=("avx9000",))]
    monkeypatch.setattr(portability, "settings", lambda: iter(found))
    monkeypatch.setattr(portability, "processor_features", lambda: {"sse2"})


def test_the_table_names_missing_processor_features(two_settings, monkeypatch, capsys):
    monkeypatch.setattr(portability, "run", lambda *_: Outcome(7, (), 12.3))
    main(Config())
    printed = capsys.readouterr().out.splitlines()
    assert next(line for line in printed if line.startswith("plain  ")).split() == ["plain", "7", "0", "12"]
    assert (
        next(line for line in printed if line.startswith("future")).split(maxsplit=1)[1].strip()
        == "not on this processor"
    )


def test_a_failure_is_named_and_ends_with_status_1(two_settings, monkeypatch, capsys):
    monkeypatch.setattr(portability, "run", lambda *_: Outcome(7, ("tests.a::[odd]",), 12.3))
    with pytest.raises(SystemExit) as stop:
        main(Config())
    assert stop.value.code == 1
    assert "  tests.a::[odd]" in capsys.readouterr().out


def test_senseless_requests_are_refused():
    with pytest.raises(ValueError, match="workers must be at least 1, but is 0"):
        main(Config(workers=0))
    with pytest.raises(ValueError, match="only must name a setting, but abacus is in none"):
        main(Config(only=("abacus",)))
