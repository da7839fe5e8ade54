"""Functions of `scalar_jit`: each construct computes the same as in Python, and all others are refused."""

import math
import re
from typing import Any

import numba
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from llvmlite import binding
from tables import table

from estimator.compilation.scalar_jit import scalar_jit, scalar_jit_from_source
from estimator.compilation.scalar_jit.llvm_translation import with_vector_metadata

NUMBERS = st.floats(allow_nan=True, allow_infinity=True)


def same(actual, expected):
    """Whether two numbers are equal; NaN is equal to itself."""
    np.testing.assert_array_equal(actual, expected)


# One operation each, so that nothing can be fused with another.
@scalar_jit
def arithmetic(a, b):
    return a + b, a - b, a * b, -a, (1 / 4) * a


@scalar_jit
def comparisons(a, b):
    return a < b, a <= b, a > b, a >= b, a == b, a != b, a == a


@scalar_jit
def choices(a, b):
    both = a > 0.0 and b > 0.0
    either = not (a <= 0.0 and b <= 0.0) or a > b
    return a if a > b else b, 1.0 if both else 0.0, 1.0 if either else 0.0, min(a, b), max(a, b, 0.0), abs(a)


@pytest.mark.parametrize("function", [arithmetic, comparisons, choices], ids=lambda f: f.__name__)
@settings(deadline=None, derandomize=True)  # the first call compiles
@given(a=NUMBERS, b=NUMBERS)
def test_operations_are_those_of_python(function, a, b):
    with np.errstate(all="ignore"):
        expected = function.py_func(np.float64(a), np.float64(b))
    same(function(a, b), expected)


@scalar_jit
def elementary(a):
    return math.sqrt(a), np.sqrt(a), math.floor(a), math.exp(-a), math.log(a), math.log1p(a), 1.0 / a, a**2


@settings(deadline=None, derandomize=True)
@given(a=st.floats(1e-6, 1e6))
def test_elementary_functions_are_those_of_the_library(a):
    np.testing.assert_allclose(elementary(a), elementary.py_func(a), rtol=4e-16)


@scalar_jit
def whole_numbers(i, j):
    half, odd = i // 2, i % 2
    return i + j, i - j, i * j, half, odd, i << 3, i >> 1, i & j, i | j, i ^ j, -i, i < j, half * 0.5, i / 4


@settings(deadline=None, derandomize=True)
@given(i=st.integers(0, 2**30), j=st.integers(-(2**30), 2**30))
def test_whole_numbers_are_those_of_python(i, j):
    assert whole_numbers(i, j) == whole_numbers.py_func(i, j)


@scalar_jit
def bits(x):
    word = np.float64(x).view(np.uint64)
    number = np.float64(x).view(np.int64)
    return word >> np.uint64(60), number >> np.int64(60), np.uint64(word).view(np.float64), word > np.uint64(2**63)


@settings(deadline=None, derandomize=True)
@given(x=st.floats(allow_nan=False))
def test_bits_are_those_of_numpy(x):
    same(bits(x), bits.py_func(x))


@scalar_jit
def swapped(pair, more):
    (a, b), c = pair, more[1]
    return (b, a), c


@scalar_jit
def called(a, b):
    total = a + b
    (b, a), c = swapped((a, b), (0.0, total))
    total *= 2.0
    return a, b, c, total


def test_functions_take_and_give_tuples():
    assert called(1.0, 2.0) == (1.0, 2.0, 3.0, 6.0)

    @numba.njit
    def from_numba(a):
        (first, second), third = swapped((a, 2.0), (3.0, 4.0))
        return first, second, third

    assert from_numba(1.0) == (2.0, 1.0, 4.0)
    assert swapped((1.0, 2.0), (3.0, 4.0)) == ((2.0, 1.0), 4.0)


@scalar_jit
def scale(W, place, factor):
    """One row of a block."""
    for j in range(4):
        W[place * 4 + j] = factor * W[place * 4 + j]


@scalar_jit
def scale_rows(W, factor):
    """Rows 1 and 2 of a block, twice: loops in loops."""
    for row in range(2):
        for _ in range(2):
            scale(W, row + 1, factor)
    scale(W, 0, 1)


def test_functions_of_blocks_write_into_them():
    W = np.arange(16.0)
    assert scale_rows(W, 3.0) is None
    expected = np.arange(16.0).reshape(4, 4) * [[1], [9], [9], [1]]
    np.testing.assert_array_equal(W.reshape(4, 4), expected)


def made(factor):
    @scalar_jit
    def multiplied(a):
        return factor * a

    return multiplied


def test_what_a_function_has_from_around_is_its_own():
    two, three = made(2.0), made(3.0)

    @scalar_jit
    def both(a):
        return two(a), three(a)

    assert both(1.0) == (2.0, 3.0)
    names = {f.translate(("double",)).name for f in (two, three, made(2.0))}
    assert len(names) == 2, "compiled code is joined by names, which must differ where the code does"


def test_functions_of_a_source_need_no_file():
    source = (
        "@scalar_jit\ndef double(a):\n    return 2.0 * a\n@scalar_jit\ndef fourfold(a):\n    return double(double(a))\n"
    )
    names = {"scalar_jit": scalar_jit_from_source(source)}
    exec(source, names)
    assert names["fourfold"](1.5) == 6.0


def keeps(W, a):
    for j in range(4):
        a = a + W[j]
    W[0] = a


def repeats(a):
    while a > 1.0:
        a = a / 2.0
    return a


def calls(a):
    return math.gamma(a)


def indexes(W, a):
    W[a] = 0.0


def forgets(a):
    return a + nothing_of_this_name  # noqa: F821


def powers(a, b):
    return a**b


def chains(a):
    b = c = a
    return b + c


def names_arguments(a):
    return max(a, 1.0, key=abs)


def returns_within(W):
    for j in range(4):
        return W[j]


def never_turns(W):
    for j in range(0):
        W[j] = 0.0


def starts_elsewhere(W):
    for j in range(1, 4):
        W[j] = 0.0


def remembers(W):
    for j in range(4):
        b = W[j]
        W[j] = 2.0 * b
    W[0] = b


@scalar_jit
def total(W):
    return W[0] + W[1]


def loses(W):
    W[0] = total(W)


def counts_back(W):
    W[-1] = 0.0


def inverts(i):
    return ~i


def is_none(a):
    return 1.0 if a is None else 0.0


def asks(W):
    W[0] = W.size


def gives_too_much(a):
    return swapped((a, a), (a, a), a)


def over_lanes(W):
    for j in range(16):
        W[16 + j] = W[j] * W[j] + 1.0
    for j in range(3):
        W[j] = 0.0


@pytest.mark.parametrize("is_wide", [False, True])
def test_loops_over_lanes_are_of_eight_where_registers_are_wide(is_wide):
    module = with_vector_metadata(next(iter(scalar_jit(over_lanes).translate(("ptr",)).definitions.values())), is_wide)
    text = str(binding.parse_assembly(module))
    assert text.count("llvm.loop.vectorize.width") == is_wide
    assert text.count("br i1") == 2
    assert len(re.findall(r"br i1 .*!llvm\.loop", text)) == is_wide


def sums_of_rows(W):
    for i in range(3):
        for k in range(3):
            for OWN_LANE in range(8):
                W[(18 + 3 * i + k) * 8 + OWN_LANE] = W[3 * i * 8 + OWN_LANE] + W[(9 + k) * 8 + OWN_LANE]


@pytest.mark.parametrize("is_wide", [False, True])
def test_lanes_within_other_loops_are_independent(is_wide):
    function = scalar_jit(sums_of_rows)
    module = with_vector_metadata(next(iter(function.translate(("ptr",)).definitions.values())), is_wide)
    text = str(binding.parse_assembly(module))
    assert len(re.findall(r"(load|store) double.*!llvm\.access\.group", text)) == 3
    assert text.count("llvm.loop.parallel_accesses") == 1
    assert len(re.findall(r"br i1 .*!llvm\.loop", text)) == 1
    W = np.random.default_rng(0).standard_normal(27 * 8)
    expected = W[: 9 * 8].reshape(3, 3, 8)[:, :1] + W[9 * 8 : 12 * 8].reshape(3, 8)
    function(W)
    np.testing.assert_array_equal(W[18 * 8 :].reshape(3, 3, 8), expected)


@pytest.mark.parametrize(("lines", "turns"), [(2, 2), (400, 1)])
def test_turns_of_short_loops_go_side_by_side(lines, turns):
    sums = "".join(f"        a{i + 1} = a{i} * a{i}\n" for i in range(lines))
    text = f"def sums(W):\n    for j in range(16):\n        a0 = W[j]\n{sums}        W[16 + j] = a{lines}\n"
    scope: dict[str, Any] = {}
    exec(text, scope)
    function = scalar_jit_from_source(text)(scope["sums"])
    module = with_vector_metadata(next(iter(function.translate(("ptr",)).definitions.values())), True)
    loop = re.search(r"br i1 .*!llvm\.loop (!\d+)", module)
    assert loop
    count = re.search(rf"^{loop[1]} = .*, (!\d+)}}$", module, re.M)
    assert count
    assert f'{count[1]} = !{{!"llvm.loop.interleave.count", i32 {turns}}}' in module
    binding.parse_assembly(module)


@table(
    ("function", "arguments", "said"),
    [
        (keeps, (np.zeros(4), 1.0), "'range(4)' in keeps keeps ['a'], which must go into a block; compile it with jit"),
        (repeats, (4.0,), "is not allowed in a scalar_jit function; compile it with jit instead"),
        (calls, (4.0,), "'math.gamma(a)' in calls calls a function that scalar_jit cannot compile"),
        (indexes, (np.zeros(4), 1.0), "indexes needs an integer, but has a float"),
        (forgets, (1.0,), "name 'nothing_of_this_name' is not defined in forgets"),
        (powers, (1.0, 2.0), "powers has Pow of floats"),
        (chains, (1.0,), "'b = c = a' in chains is not allowed in a scalar_jit function"),
        (names_arguments, (1.0,), "in names_arguments gives arguments by name"),
        (returns_within, (np.zeros(4),), "'range(4)' in returns_within is no plain loop over range(n)"),
        (never_turns, (np.zeros(4),), "'range(0)' in never_turns must have a turn"),
        (starts_elsewhere, (np.zeros(4),), "'range(1, 4)' in starts_elsewhere is no plain loop over range(n)"),
        (remembers, (np.zeros(4),), "name 'b' is not defined in remembers; assign it before, and not in a loop"),
        (loses, (np.zeros(4),), "loses calls total, which has a block and a result; write the result into a block"),
        (counts_back, (np.zeros(4),), "'W[-1]' in counts_back counts from the end"),
        (inverts, (1,), "inverts negates a value that is not a number"),
        (is_none, (1.0,), "is_none compares by Is; use < <= > >= == or !="),
        (asks, (np.zeros(4),), "'W.size' in asks asks a number or a block for an attribute"),
        (gives_too_much, (1.0,), "swapped takes ['pair', 'more'], but is given 3 arguments; give all"),
        (scale_rows.py_func, (np.zeros((4, 4)), 1.0), "scale_rows needs flat, contiguous float64 arrays, but is given"),
        (scale_rows.py_func, (np.zeros(16, np.float32), 1.0), "scale_rows needs flat, contiguous float64 arrays"),
        (arithmetic.py_func, ("a", "b"), "arithmetic takes numbers, tuples of them and flat arrays, but is given"),
    ],
)
def test_unsupported_constructs_are_refused(function, arguments, said):
    with pytest.raises(Exception, match=re.escape(said)):
        scalar_jit(function)(*arguments)
