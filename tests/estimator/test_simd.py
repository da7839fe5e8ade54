"""SIMD lanes: numbered rows, compiled loops, and the digest of the sources."""

import ast
import importlib
import re
import sys
from pathlib import Path

import numba
import numpy as np
import pytest
from tables import table

from estimator.compilation import simd
from estimator.compilation.simd import LANES, jit, jit_closure, jit_single_lane, lanewise, number_rows

LAYOUT = {"a": 0, "b": 1, "total": 2, "product": 3}


def block():
    return np.random.default_rng(0).standard_normal(len(LAYOUT) * LANES)


def test_an_inner_function_is_called_from_compiled_code_and_from_python():
    @jit
    def twice(x, y=1.0):
        return 2 * x + y

    @numba.njit
    def caller(x):
        return twice(x) + twice(1, x)

    assert (caller(3.0), twice(3.0), twice(2, y=2)) == (12.0, 7.0, 6)
    # The caller needed two overloads, and none of them has an entry for Python.
    assert len(twice.overloads) == 2
    for compiled in (*twice.overloads.values(), *caller.overloads.values()):
        engine, named = compiled.library.codegen._engine, compiled.fndesc.llvm_cpython_wrapper_name
        assert engine.is_symbol_defined(named) == (compiled is caller.overloads[(numba.float64,)])


def test_rows_are_numbered_in_order():
    assert number_rows("a b", " c\n d", first_row=3) == {"a": 3, "b": 4, "c": 5, "d": 6}


def test_rows_refuse_a_repeated_name():
    with pytest.raises(ValueError, match=re.escape("every row once, but has ['b'] twice; rename them")):
        number_rows("a b", "c b")


def add_and_multiply(a, b, factor, shift):
    return a + factor * b, a * b + shift


def test_lanewise_with_uniform_arguments():
    W = block()
    a, b = W.reshape(-1, LANES)[:2].copy()
    # The loop takes them in the order of `uniform`, not of the function.
    loop = lanewise(LAYOUT, "total product", uniform="shift factor")(add_and_multiply)
    loop(W, 100.0, 2.0)
    np.testing.assert_array_equal(W.reshape(-1, LANES)[:2], [a, b])
    np.testing.assert_allclose(W.reshape(-1, LANES)[2:], [a + 2.0 * b, a * b + 100.0], rtol=1e-14)


def swapped(a, b):
    return b, a


def test_lanewise_writes_after_it_has_read():
    W = block()
    a, b = W.reshape(-1, LANES)[:2].copy()
    lanewise(LAYOUT, "a b")(swapped)(W)
    np.testing.assert_array_equal(W.reshape(-1, LANES)[:2], [b, a])


def sum_and_product(a, b):
    return a + b, a * b


def test_lane_functions_change_one_lane_or_none():
    W = block()
    before = W.reshape(-1, LANES).copy()
    a, b = before[:2]
    total, product = jit_single_lane(LAYOUT, sum_and_product)(W, 5)
    np.testing.assert_allclose([total, product], [a[5] + b[5], a[5] * b[5]], rtol=1e-14)
    np.testing.assert_array_equal(W.reshape(-1, LANES), before)
    lanewise(LAYOUT, "total product", uniform="factor shift", single_lane=True)(add_and_multiply)(W, 5, 2.0, 100.0)
    changed = W.reshape(-1, LANES) != before
    np.testing.assert_array_equal(np.argwhere(changed), [[2, 5], [3, 5]])


@table("uniform", ["factor", "factor shift a"])
def test_a_parameter_is_a_row_or_uniform(uniform):
    with pytest.raises(ValueError, match=r"(shift|a) of add_and_multiply must be a row or uniform, and not both"):
        lanewise(LAYOUT, "total product", uniform=uniform)(add_and_multiply)


def test_the_digest_of_sources_covers_each_of_them(tmp_path):
    def digest(folder):
        return simd.source_digest.__wrapped__((folder,))

    (tmp_path / "folder").mkdir()
    (tmp_path / "kernel.py").write_text("a = 1\n")
    (tmp_path / "folder" / "scalar.py").write_text("b = 1\n")
    first = digest(tmp_path)
    assert digest(tmp_path) == first
    (tmp_path / "notes.txt").write_text("no source")
    assert digest(tmp_path) == first
    (tmp_path / "folder" / "scalar.py").write_text("b = 2\n")
    changed = digest(tmp_path)
    assert changed != first
    (tmp_path / "new.py").write_text("c = 1\n")
    assert digest(tmp_path) not in (first, changed)


def test_code_depends_on_its_package_and_those_below():
    root = Path(simd.__file__).parents[2]
    files = (
        "estimator/engine/printer_numba.py",
        "duffing_env/kernel.py",
        "agents/planning/receding_horizon.py",
        "benchmarks/component_timing.py",
    )
    names = {file: [folder.name for folder in simd.source_folders(str(root / file))] for file in files}
    below = ["estimator", "duffing_env", "agents"]
    assert list(names.values()) == [below[:1], below[:2], below, [*below, "research", "benchmarks"]]


def test_a_cached_kernel_follows_the_functions_it_calls(tmp_path, monkeypatch):
    (tmp_path / "scalar_of_lanes.py").write_text(
        "from estimator.compilation.simd import jit\n\n@jit\ndef f():\n    return 1\n"
    )
    (tmp_path / "kernel_of_lanes.py").write_text(
        "from estimator.compilation.simd import kernel\nfrom scalar_of_lanes import f\n\n"
        "@kernel\ndef run():\n    return f()\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    digest = simd.source_digest.__wrapped__
    monkeypatch.setattr(simd, "source_digest", digest)  # a new process reads the sources again

    def result():
        for name in ("scalar_of_lanes", "kernel_of_lanes"):
            sys.modules.pop(name, None)
        importlib.invalidate_caches()
        run = importlib.import_module("kernel_of_lanes").run
        return run(), sum(run.stats.cache_hits.values())

    assert result() == (1, 0)
    assert result() == (1, 1)
    # Only the called function changes; its file is longer, so that Python itself compiles it again.
    (tmp_path / "scalar_of_lanes.py").write_text(
        "from estimator.compilation.simd import jit\n\n@jit\ndef f():\n    return 1234\n"
    )
    assert result() == (1234, 0)


def test_functions_that_differ_have_names_that_differ():
    """The linker takes two functions of one name for the same, if two processes compiled them."""
    layout = number_rows("p q r s")

    def double(p):
        return 2.0 * p

    loops = [lanewise(layout, target)(double) for target in "qrs"]
    loops += [lanewise({**layout, "p": 3}, "q")(double), lanewise(layout, "q", lanes=1)(double)]
    assert len({loop.py_func.__qualname__ for loop in loops}) == 5

    def outer(kind):
        @jit_closure(kind)
        def inner(p):
            return p

        return inner

    assert outer("one").py_func.__qualname__ != outer("two").py_func.__qualname__


def test_functions_within_functions_are_named_apart():
    """Two variants of one name would be one function for the linker (`estimator.compilation.simd.jit_closure`)."""
    root = Path(__file__).parents[2]
    unnamed = []

    def look(node, within, name):
        for child in ast.iter_child_nodes(node):
            is_function = isinstance(child, ast.FunctionDef)
            if is_function and within:
                names = [ast.unparse(decorator) for decorator in child.decorator_list]
                unnamed.extend(f"{name}: {child.name}" for decorator in names if decorator in ("jit", "kernel"))
            look(child, within or is_function, name)

    packages = ("estimator", "duffing_env", "agents", "research")
    for path in [path for package in packages for path in (root / package).rglob("*.py")]:
        if path.parent.name == "__pycache__":  # generated
            continue
        look(ast.parse(path.read_text(encoding="utf-8")), False, path.name)
    assert unnamed == []
