"""How far work is: seldom, and with the time that is left."""

import itertools

import pytest

from estimator.support import progress


@pytest.fixture
def clock(monkeypatch):
    """A clock that stands still until it is set."""
    at = {"now": 1000.0}
    monkeypatch.setattr(progress.time, "monotonic", lambda: at["now"])
    monkeypatch.setattr(progress, "REPORT_INTERVAL", 5.0)
    return at


def test_lines_say_the_share_and_the_time_that_is_left(clock, capsys):
    with progress.show_progress("Training") as tell:
        tell(0.0)
        clock["now"] += 4.9
        tell(0.1, "return 3")
        assert capsys.readouterr().err == ""
        clock["now"] += 5.1
        tell(0.25, "return 4")
        tell(0.26, "at once again")
    assert capsys.readouterr().err == "Training 25 %, 30 s left: return 4\n"


def test_the_remaining_time_assumes_the_speed_so_far(clock, capsys):
    with progress.show_progress("Training") as tell:
        tell(0.5)
        clock["now"] += 10.0
        tell(0.6)
        clock["now"] += 5.0
        tell(0.5)
    assert capsys.readouterr().err.splitlines() == ["Training 60 %, 40 s left", "Training 50 %"]


def test_lines_become_seldom_and_are_short(clock, capsys):
    with progress.show_progress("Evaluating") as tell:
        for second in range(3600):
            clock["now"] += 1.0
            tell(second / 3600, "a policy of a long name " * 9)
    lines = capsys.readouterr().err.splitlines()
    assert 10 < len(lines) < 40
    assert max(map(len, lines)) == 80


def test_a_terminal_has_a_bar(clock, monkeypatch, capsys):
    monkeypatch.setattr("sys.stderr.isatty", lambda: True)
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("COLUMNS", "300")
    with progress.show_progress("Designing") as tell:
        for share in (0.0, 0.5):
            clock["now"] += 30.0
            tell(share, "a candidate " * 30)
    said = capsys.readouterr().err
    assert "Designing 50 %, " in said
    for line in said.replace("\r", "\n").split("\n"):
        plain = "".join(letter for letter, _ in itertools.groupby(line) if letter.isprintable())
        assert len(plain) < 130
