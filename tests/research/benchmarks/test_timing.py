import math
from types import SimpleNamespace

import pytest

from benchmarks import timed_rounds
from benchmarks.timed_rounds import Result, Row, measure, timed


def sleeping(seconds: float, calls: list[str], name: str) -> Row:
    def run(count: int) -> tuple[float, float]:
        calls.append(name)
        return count * seconds, 10.0 * count

    return Row(name, "env-steps/s", run, at_least=0)


def test_rounds_visit_every_row_once_and_begin_at_different_ones() -> None:
    calls: list[str] = []
    results = measure([sleeping(1, calls, name) for name in "abc"], repetitions=3)
    rounds = ["".join(calls[i : i + 3]) for i in range(0, 9, 3)]
    assert rounds == ["abc", "bca", "cab"]
    assert all(len(result.values) == 3 for result in results.values())


def test_rates_and_costs() -> None:
    def run(count: int) -> tuple[float, float]:
        return 0.5 * count, 100.0 * count

    for unit, expected in (("env-steps/s", 200.0), ("µs/sample", 5000.0), ("ns/env-step", 5e6), ("s", 0.005)):
        assert measure([Row("row", unit, run, at_least=0)], 1)["row"].median == pytest.approx(expected)


def test_short_runs_are_lengthened_and_not_one_of_the_warm_up_is_kept() -> None:
    counts: list[int] = []

    def run(count: int) -> tuple[float, float]:
        counts.append(count)
        return 0.001 * count, float(count)

    result = measure([Row("row", "env-steps/s", run, at_least=0.25)], 5)["row"]
    assert counts[:2] == [1, 1]
    assert len(set(counts[-5:])) == 1
    assert 0.25 <= 0.001 * counts[-1] < 1.0
    assert result.values == pytest.approx([1000.0] * 5)


def test_a_row_that_fails_is_reported_and_the_others_go_on() -> None:
    def run(count: int) -> tuple[float, float]:
        raise ImportError("No module named 'envpool'")

    results = measure([Row("peer", "env-steps/s", run), sleeping(1, [], "ours")], 2)
    assert results["peer"].values == ()
    assert results["peer"].to_dict()["not_available"] == "ImportError: No module named 'envpool'"
    assert math.isnan(results["peer"].median)
    assert len(results["ours"].values) == 2


def test_a_row_that_fails_later_has_no_values() -> None:
    seconds = iter([1.0])

    def run(count: int) -> tuple[float, float]:
        return next(seconds), 1.0

    result = measure([Row("row", "s", run, at_least=0)], 2)["row"]
    assert result.values == ()
    assert "StopIteration" in result.reason


def test_bad_requests_are_refused() -> None:
    row = sleeping(1, [], "a")
    with pytest.raises(ValueError, match="repetitions must be at least 1, but is 0"):
        measure([row], 0)
    with pytest.raises(ValueError, match="different names"):
        measure([row, row], 1)


def test_timed_measures_the_work_only(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = SimpleNamespace(now=100.0, perf_counter=lambda: clock.now)
    monkeypatch.setattr(timed_rounds, "time", clock)

    def action(count: int) -> float:
        clock.now += 0.5
        return 7.0 * count

    assert timed(action)(3) == (0.5, 21.0)


def test_results_say_their_median_minimum_and_maximum() -> None:
    entry = Result("row", "s", (3.0, 1.0, 2.0, 9.0, 5.0)).to_dict()
    assert (entry["median"], entry["min"], entry["max"], entry["values"]) == (3.0, 1.0, 9.0, [3.0, 1.0, 2.0, 9.0, 5.0])
