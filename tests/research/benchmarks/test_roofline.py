"""Operation counts equal counts by hand, and the yardsticks compute what they state."""

import pytest

from benchmarks.roofline import count, divide, move, multiply_add, pieces, take_root
from estimator.compilation.simd import lanewise, number_rows


def test_a_function_has_the_operations_that_one_counts_by_hand() -> None:
    @lanewise(number_rows("a b c d"), "c d", uniform="x")
    def example(a, b, x):
        product = a * b + x
        return product / (a - b), product * product

    assert count({example: 1}) == {"flop": 5, "division": 1, "root": 0, "store": 2}
    assert count({example: 3}) == {"flop": 15, "division": 3, "root": 0, "store": 6}


@pytest.mark.parametrize("factorisation", ["structured", "mean_field"])
def test_every_piece_of_a_step_is_counted(factorisation: str) -> None:
    for name, functions in pieces(factorisation).items():
        assert count(functions)["flop"] > 10, name


def test_the_yardsticks_do_what_they_say() -> None:
    assert count({multiply_add: 1})["flop"] == 128
    assert count({divide: 1}) == {"flop": 4, "division": 4, "root": 0, "store": 4}
    assert count({take_root: 1}) == {"flop": 4, "division": 0, "root": 4, "store": 4}
    assert count({move: 1}) == {"flop": 4, "division": 0, "root": 0, "store": 4}
