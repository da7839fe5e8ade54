"""Section 4a: roofline of the compiled step: its share of this processor's peak, and the time of its operations.

The yardsticks are compiled like the step (`estimator.compilation.simd.lanewise`): multiply-adds, divisions, square
roots and copies on independent values that stay in the nearest cache. All runs on one thread.

Operations are counted in the code that `estimator.compilation.scalar_jit` gives to LLVM, once for every lane. LLVM
merges a few equal expressions; the assembly has the same number of divisions and roots.
"""

import re
from collections import Counter
from collections.abc import Callable
from typing import Any

import numpy as np

from benchmarks.component_timing import experiment_of, plants
from benchmarks.section_tables import Claim, Section
from benchmarks.timed_rounds import Result, Row, measure, timed
from duffing_env.batch import Batch
from duffing_env.experiment_config import SimulatedExperiment
from duffing_env.kernel import RESET_NEXT_STEP
from duffing_env.kernel_stages.generated_environment_functions import generated_functions
from duffing_env.kernel_stages.plant_stages import compile_noise_draw
from duffing_env.kernel_stages.sample_stages import compile_update
from duffing_env.storage.kernel_spec import block_layout
from estimator.compilation.scalar_jit import scalar_jit
from estimator.compilation.simd import LANES, jit, lanewise, number_rows
from estimator.inference import mean_field

#: Environments side by side.
SIZE = 1024

#: Samples of an episode.
STEPS = 256

#: Calls of a yardstick in one timed unit.
REPEATS = 1000

#: Share of the multiply-add peak to reach [%].
TARGET_SHARE = 30.0

#: Name of the inference of each factorisation.
_INFERENCE = {"structured": "inference, structured", "mean_field": "inference, mean field"}
#: Pieces of a step, and the factorisation of the step in which each is timed.
_PIECES = {
    "noise": "structured",
    "plant": "structured",
    **{name: rule for rule, name in _INFERENCE.items()},
    "reward and end": "structured",
    "observation": "structured",
}

#: Name of the whole step of each factorisation.
_STEPS = {"structured": "whole step, structured", "mean_field": "whole step, mean field"}

#: Rows of a yardstick's block.
_YARDSTICK = number_rows("a b c d")

#: Names of the yardsticks.
_FUSED = "multiply-adds, one thread"
_DIVISIONS = "divisions, one thread"
_ROOTS = "square roots, one thread"
_STORES = "loads and stores, nearest cache, one thread"


@scalar_jit
def _four(value, x, y):
    value = value * x + y
    value = value * x + y
    value = value * x + y
    return value * x + y


@scalar_jit
def _sixteen(value, x, y):
    return _four(_four(_four(_four(value, x, y), x, y), x, y), x, y)


# Four rows of LANES values are 16 independent vectors with AVX-512 and 32 with AVX2, enough to hide the latency.
@lanewise(_YARDSTICK, "a b c d", uniform="x y")
def multiply_add(a, b, c, d, x, y):
    """64 fused multiply-adds per lane, in four independent chains."""
    return _sixteen(a, x, y), _sixteen(b, x, y), _sixteen(c, x, y), _sixteen(d, x, y)


@lanewise(_YARDSTICK, "a b c d", uniform="x")
def divide(a, b, c, d, x):
    """4 divisions per lane."""
    return x / a, x / b, x / c, x / d


@lanewise(_YARDSTICK, "a b c d")
def take_root(a, b, c, d):
    """4 square roots per lane."""
    return np.sqrt(a), np.sqrt(b), np.sqrt(c), np.sqrt(d)


@lanewise(_YARDSTICK, "a b c d", uniform="x")
def move(a, b, c, d, x):
    """4 loads and 4 stores per lane, each with an addition: the compiler would remove bare copies."""
    return b + x, c + x, d + x, a + x


#: Function of each yardstick, and the operation that it counts.
_YARDSTICKS = {
    _FUSED: (multiply_add, "flop"),
    _DIVISIONS: (divide, "division"),
    _ROOTS: (take_root, "root"),
    _STORES: (move, "store"),
}

#: Arguments of lane functions that are blocks: the systems', and the results' beside it.
_BLOCKS = ("W", "B")

#: Operations that an instruction of LLVM counts as.
_INSTRUCTIONS = {
    r"= f(?:add|sub|mul) ": ("flop",),
    r"= fdiv ": ("flop", "division"),
    r"@llvm\.sqrt": ("flop", "root"),
    r"\bstore double": ("store",),
}


def count(functions: dict[Any, int]) -> Counter[str]:
    """Count operations per lane: ``flop``, which includes divisions and roots, ``division``, ``root``, ``store``.

    Args:
        functions: lane functions, and the number of calls of each.
    """
    counted: Counter[str] = Counter()
    for function, times in functions.items():
        kinds = tuple("ptr" if name in _BLOCKS else "double" for name in function.source.arguments)
        text = "".join(function.translate(kinds).definitions.values())
        for instruction, names in _INSTRUCTIONS.items():
            for name in names:
                counted[name] += times * len(re.findall(instruction, text))
    return counted


def pieces(factorisation: str) -> dict[str, dict[Any, int]]:
    """Lane functions of each piece of a step, and how often a step calls them."""
    experiment = experiment_of(factorisation)
    kind = experiment.kernel_spec
    code = generated_functions(kind)
    if factorisation == "structured":
        inference = {compile_update(kind): 1}
    else:
        begin, iterate, end, _ = mean_field.compile_mean_field(block_layout(kind))
        inference = {begin: 1, iterate: experiment.kernel_params.iterations, end: 1}
    return {
        "noise": {compile_noise_draw(block_layout(kind)): 1},
        "plant": {code.step_plant: 1},
        _INFERENCE[factorisation]: inference,
        "reward and end": {code.finish_step_lanes: 1},
        "observation": {code.observe_lanes: 1},
    }


def run(repetitions: int, on_row: Callable[[str], None]) -> Section:
    """Time the step, its pieces and the yardsticks, and compare them."""
    found = {rule: pieces(rule) for rule in _STEPS}
    operations = {name: count(found[rule][name]) for name, rule in _PIECES.items()}
    for rule, name in _STEPS.items():
        operations[name] = sum((count(functions) for functions in found[rule].values()), start=Counter())
    timed_rows = [
        Row(name, "flop/s" if name == _FUSED else "op/s", timed(_yardstick(function, count({function: 1})[work])))
        for name, (function, work) in _YARDSTICKS.items()
    ]
    timed_rows += [Row(name, "env-steps/s", timed(_piece(found[rule][name], rule))) for name, rule in _PIECES.items()]
    timed_rows += [Row(name, "env-steps/s", timed(_steps(rule))) for rule, name in _STEPS.items()]
    results = measure(timed_rows, repetitions, on_row)
    peak = results[_FUSED].median
    claims = [
        Claim(
            f"of the multiply-add peak: {name}",
            100 * operations[name]["flop"] * results[name].median / peak,
            TARGET_SHARE,
            unit="%",
        )
        for name in (*_INFERENCE.values(), *_STEPS.values())
    ]
    lines = [_account(name, counted, results) for name, counted in operations.items()]
    notes = [
        f"Peak: {_FUSED}, {peak / 1e9:.3g} Gflop/s. Operations are counted in the code given to the compiler; a "
        f"multiply-add is two. {SIZE} environments; steps that only start an episode run but do not count.",
        "Account, ns per env-step: time of the operations alone, at the rates of the yardsticks; `arithmetic` is\n"
        "additions and multiplications, as if each stood in a multiply-add. The time of a step beyond its pieces is\n"
        "copying: of beliefs, outcomes and observations.\n\n"
        f"{'':<28}{'flop':>7}{'div':>6}{'sqrt':>6}{'arithmetic':>12}{'div+sqrt':>10}{'stores':>8}{'sum':>8}"
        f"{'measured':>10}\n" + "\n".join(lines),
    ]
    return Section("Roofline, one thread", list(results.values()), claims, notes, {"operations": operations})


def _account(name: str, counted: Counter[str], results: dict[str, Result]) -> str:
    """One line: counts, the time of each kind of operation, their sum, and the measured time [ns]."""
    slow = counted["division"] + counted["root"]
    arithmetic = 1e9 * (counted["flop"] - slow) / results[_FUSED].median
    dividing = 1e9 * (counted["division"] / results[_DIVISIONS].median + counted["root"] / results[_ROOTS].median)
    storing = 1e9 * counted["store"] / results[_STORES].median
    return (
        f"{name:<28}{counted['flop']:>7}{counted['division']:>6}{counted['root']:>6}{arithmetic:>12.2f}"
        f"{dividing:>10.2f}{storing:>8.2f}{arithmetic + dividing + storing:>8.2f}{1e9 / results[name].median:>10.2f}"
    )


def _yardstick(function: Any, operations_per_lane: int) -> Callable[[int], float]:
    """Time a yardstick on one block."""
    values, call = np.ones((1, len(_YARDSTICK) * LANES)), _calls({function: REPEATS})

    def action(count: int) -> float:
        for _ in range(count):
            call(values, values[0])
        assert np.isfinite(values).all()
        return count * REPEATS * LANES * operations_per_lane

    return action


def _piece(functions: dict[Any, int], factorisation: str) -> Callable[[int], float]:
    """Time a piece of the step on all blocks, which lie in the same caches as in the step."""
    initial, call = plants(SIZE, factorisation), _calls(functions)
    blocks, beside = initial.copy(), np.zeros(initial.shape[1])

    def action(count: int) -> float:
        blocks[:] = initial
        for _ in range(count * STEPS):
            call(blocks, beside)
        return count * STEPS * SIZE

    return action


def _calls(functions: dict[Any, int]) -> Any:
    """Compile ``call(blocks, beside)``, which calls each lane function its number of times on every block.

    All results beside a block go into ``beside``. Uniform arguments have any value: they do not change the time.
    """
    piece = _nothing
    for function, times in functions.items():
        piece = _then(piece, function, times)

    @jit
    def call(blocks, beside):
        for b in range(len(blocks)):
            piece(blocks[b], beside)

    return call


@jit
def _nothing(W, B):
    pass


def _then(before: Any, function: Any, times: int) -> Any:
    """Compile a function that calls ``before``, then the lane function ``times`` times."""
    names = function.source.arguments
    uniform = (1e-3,) * sum(name not in _BLOCKS for name in names)

    @jit
    def both(W, B):
        before(W, B)
        for _ in range(times):
            function(W, *uniform)

    @jit
    def both_beside(W, B):
        before(W, B)
        for _ in range(times):
            function(W, B, *uniform)

    return both_beside if "B" in names else both


def _steps(rule: str) -> Callable[[int], float]:
    """Time the compiled step, without the Python around it."""
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
