"""Coverage under policies: a share of intervals, its verdict, and the tracks that are matched."""

import json

import numpy as np
import pytest

from agents.evaluation.rollout import evaluate
from benchmarks.coverage_policies import TRACKS, Config, main, measure, run


def test_coverage_is_that_of_the_leaderboard():
    row = measure("uniform", "duffing_env/Short-v0", 40, 3)
    (evaluation,) = evaluate(["uniform"], "duffing_env/Short-v0", 40, 3)
    assert row.coverage == pytest.approx(evaluation.metrics["coverage"].mean())
    assert row.low < row.coverage < row.high
    assert np.mean(row.by_coefficient) == pytest.approx(row.coverage)


def test_planners_of_the_difference_equation_do_not_play_the_other():
    pairs = [(row.policy, row.track) for row in run(Config(("efe-myopic", "prbs"), TRACKS[-2:], systems=4))]
    assert pairs == [("efe-myopic", TRACKS[-2]), ("prbs", TRACKS[-2]), ("prbs", TRACKS[-1])]


def test_the_command_tells_what_missed(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("benchmarks.coverage_policies.LOWEST", 0.999)
    main(Config(("prbs",), ("duffing_env/Short-v0",), systems=20, json=tmp_path / "coverage.json"))
    printed = capsys.readouterr().out
    assert "MISS" in printed
    assert "missed: prbs on duffing_env/Short-v0" in printed
    (row,) = json.loads((tmp_path / "coverage.json").read_text())
    assert row["passed"] is False
