"""Section 4a: how near the compiled step comes to what this processor can do, and what keeps it from getting nearer.

The yardsticks are compiled the same way as the step (`estimator.lanes.lanewise`): multiply-adds, divisions, square
roots and copies on independent values that stay in the nearest cache. Everything here runs on one thread.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import Any

import numpy as np

from benchmarks.assembly import NotCounted, Operations, count
from benchmarks.pieces import experiment_of, plants
from benchmarks.report import Claim, Section
from benchmarks.timing import Result, Row, measure, timed
from duffing_env.batch import Batch
from duffing_env.experiment import SimulatedExperiment
from duffing_env.inference import updater
from duffing_env.kernel import RESET_NEXT_STEP
from duffing_env.layout import layout_of
from duffing_env.sources import parts
from duffing_env.stages import noise_drawer
from estimator.inference import mean_field
from estimator.lanes import LANES, jit, kernel, lanewise, rows
from estimator.straight import straight

SIZE = 1024
STEPS = 256
REPEATS = 1000
TARGET_SHARE = 30.0

_INFERENCE = {"structured": "inference, structured", "mean_field": "inference, mean field"}
# The pieces of a step, and in whose step each is timed.
_PIECES = {
    "noise": "structured",
    "plant": "structured",
    **{name: rule for rule, name in _INFERENCE.items()},
    "reward and end": "structured",
    "observation": "structured",
}
_STEPS = {"structured": "whole step, structured", "mean_field": "whole step, mean field"}

_YARDSTICK = rows("a b c d")
_FUSED = "multiply-adds, one thread"
_DIVISIONS = "divisions, one thread"
_ROOTS = "square roots, one thread"
_STORES = "loads and stores, nearest cache, one thread"


@straight
def _four(value, x, y):
    value = value * x + y
    value = value * x + y
    value = value * x + y
    return value * x + y


@straight
def _sixteen(value, x, y):
    return _four(_four(_four(_four(value, x, y), x, y), x, y), x, y)


# 4 rows of LANES values are 16 independent vectors with AVX-512, 32 with AVX2: enough to hide an operation's latency.
@lanewise(_YARDSTICK, "a b c d", uniform="x y")
def multiply_add(a, b, c, d, x, y):
    """64 fused multiply-adds per lane, in four independent chains."""
    return _sixteen(a, x, y), _sixteen(b, x, y), _sixteen(c, x, y), _sixteen(d, x, y)


@lanewise(_YARDSTICK, "a b c d", uniform="x")
def divide(a, b, c, d, x):
    """4 divisions per lane."""
    return x / a, x / b, x / c, x / d


@lanewise(_YARDSTICK, "a b c d", uniform="x")
def take_root(a, b, c, d, x):
    """4 square roots per lane."""
    return np.sqrt(a), np.sqrt(b), np.sqrt(c), np.sqrt(d)


@lanewise(_YARDSTICK, "a b c d", uniform="x")
def move(a, b, c, d, x):
    """4 loads and 4 stores per lane, and an addition each, without which the compiler would leave them out."""
    return b + x, c + x, d + x, a + x


@kernel
def _multiply_add_often(W, repeats):
    for _ in range(repeats):
        multiply_add(W, 0.999999, 1e-6)


@kernel
def _divide_often(W, repeats):
    for _ in range(repeats):
        divide(W, 1.0)


@kernel
def _take_root_often(W, repeats):
    for _ in range(repeats):
        take_root(W, 1.0)


@kernel
def _move_often(W, repeats):
    for _ in range(repeats):
        move(W, 1e-9)


def pieces(factorisation: str) -> dict[str, dict[Any, int]]:
    """The pieces of a step: lane functions, and how often a step calls them."""
    experiment = experiment_of(factorisation)
    kind = experiment.kind
    code = parts(kind)
    if factorisation == "structured":
        inference = {updater(kind): 1}
    else:
        begin, iterate, end, _ = mean_field.pieces(layout_of(kind))
        inference = {begin: 1, iterate: experiment.setup.iterations, end: 1}
    return {
        "noise": {noise_drawer(layout_of(kind)): 1},
        "plant": {code.plant: 1},
        _INFERENCE[factorisation]: inference,
        "reward and end": {code.settle: 1},
        "observation": {code.observe_lanes: 1},
    }


def run(repetitions: int, on_row: Callable[[str], None]) -> Section:
    """Time the step, its pieces and the yardsticks, and put the ones beside the others."""
    title = "Roofline, one thread"
    found = {rule: pieces(rule) for rule in _STEPS}
    try:
        operations = {name: _count(found[rule][name]) for name, rule in _PIECES.items()}
        wholes = {
            name: _total([_count(functions) for functions in found[rule].values()]) for rule, name in _STEPS.items()
        }
        per_lane = {_FUSED: 2 * count(multiply_add).fused, _DIVISIONS: count(divide).divisions,
                    _ROOTS: count(take_root).roots, _STORES: count(move).stores}  # fmt: skip
    except NotCounted as reason:
        return Section(title, [Result("operations", "flop/env-step", reason=str(reason))])
    yardsticks = {
        _FUSED: _multiply_add_often,
        _DIVISIONS: _divide_often,
        _ROOTS: _take_root_often,
        _STORES: _move_often,
    }
    timed_rows = [
        Row(name, "flop/s" if name == _FUSED else "op/s", timed(_yardstick(function, per_lane[name])))
        for name, function in yardsticks.items()
    ]
    timed_rows += [Row(name, "env-steps/s", timed(_piece(found[rule][name], rule))) for name, rule in _PIECES.items()]
    timed_rows += [Row(name, "env-steps/s", timed(_steps(rule))) for rule, name in _STEPS.items()]
    results = measure(timed_rows, repetitions, on_row)
    operations |= wholes
    judged = {name: (operations[name], results[name]) for name in (*_INFERENCE.values(), *_STEPS.values())}
    peak = results[_FUSED].median
    claims = [
        Claim(f"of the multiply-add peak: {name}", 100 * counted.flops * result.median / peak, TARGET_SHARE, unit="%")
        for name, (counted, result) in judged.items()
    ]
    lines = [_account(name, counted, results) for name, counted in operations.items()]
    notes = [
        f"Peak: {_FUSED}, {peak / 1e9:.3g} Gflop/s, vectors of {operations[_STEPS['structured']].vector_bits} bits. "
        f"Operations are counted in the assembly of the compiled functions (benchmarks/assembly.py); a multiply-add is "
        f"two. {SIZE} environments; steps that only start an episode take place, but do not count.",
        "Account, ns per env-step: what the operations would take if nothing else had to be done, at the rates of the\n"
        "yardsticks; `arithmetic` is additions, multiplications and multiply-adds, which share their units. What a\n"
        "step takes beyond its pieces is copying: beliefs that are kept, outcomes, observations.\n\n"
        f"{'':<28}{'flop':>7}{'div':>6}{'sqrt':>6}{'arithmetic':>12}{'div+sqrt':>10}{'stores':>8}{'sum':>8}"
        f"{'measured':>10}\n" + "\n".join(lines),
    ]
    data = {name: {**vars(counted), "flops": counted.flops} for name, counted in operations.items()}
    return Section(title, list(results.values()), claims, notes, {"operations": data})


def _count(functions: dict[Any, int]) -> Operations:
    return _total([count(function) * times for function, times in functions.items()])


def _total(operations: list[Operations]) -> Operations:
    return sum(operations, start=Operations())


def _account(name: str, operations: Operations, results: dict[str, Result]) -> str:
    """One line: nanoseconds that each kind of operation needs, their sum, and the time that was measured."""
    arithmetic = 1e9 * 2 * (operations.simple + operations.fused) / results[_FUSED].median
    slow = 1e9 * operations.divisions / results[_DIVISIONS].median
    slow += 1e9 * operations.roots / results[_ROOTS].median
    stores = 1e9 * operations.stores / results[_STORES].median
    measured = 1e9 / results[name].median
    return (
        f"{name:<28}{operations.flops:>7.0f}{operations.divisions:>6.0f}{operations.roots:>6.0f}"
        f"{arithmetic:>12.2f}{slow:>10.2f}{stores:>8.2f}{arithmetic + slow + stores:>8.2f}{measured:>10.2f}"
    )


def _yardstick(function: Any, operations_per_lane: float) -> Callable[[int], float]:
    values = np.ones(len(_YARDSTICK) * LANES)

    def action(count: int) -> float:
        function(values, count * REPEATS)
        assert np.isfinite(values).all()
        return count * REPEATS * LANES * operations_per_lane

    return action


def _piece(functions: dict[Any, int], factorisation: str) -> Callable[[int], float]:
    """A piece of the step, again and again on blocks that lie in the nearer caches as those of the step do."""
    initial = plants(SIZE, factorisation)
    blocks = initial.copy()
    piece = _nothing
    for function, times in functions.items():
        piece = _then(piece, function, times)

    @jit
    def call(blocks):
        for b in range(len(blocks)):
            piece(blocks[b])

    def action(count: int) -> float:
        blocks[:] = initial
        for _ in range(count * STEPS):
            call(blocks)
        return count * STEPS * SIZE

    return action


@jit
def _nothing(W):
    pass


def _then(before: Any, function: Any, times: int) -> Any:
    """What was to be done before, and then a lane function. Its uniform arguments do not matter to the time."""
    arguments = (1e-3,) * (len(inspect.signature(function.py_func).parameters) - 1)

    @jit
    def both(W):
        before(W)
        for _ in range(times):
            function(W, *arguments)

    return both


def _steps(rule: str) -> Callable[[int], float]:
    """The compiled step, without the Python around it."""
    batch = Batch(SimulatedExperiment(factorisation=rule), SIZE, RESET_NEXT_STEP)
    for row in range(SIZE):
        batch.seed(row, np.random.default_rng(row))
    batch.reset(np.ones(SIZE, dtype=np.bool_))
    actions = np.random.default_rng(0).uniform(-1, 1, (64, SIZE)).astype(np.float32)

    def action(count: int) -> float:
        for t in range(count * (STEPS + 1)):
            batch.step(actions[t % 64])
        return count * STEPS * SIZE

    return action
