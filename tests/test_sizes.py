"""A module, a function and a signature are short enough to be read at once; each exception has a name and a reason."""

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGES = ("estimator", "duffing_env", "agents")
MODULE_LINES, FUNCTION_LINES, PARAMETERS = 350, 100, 10

#: Functions that may be longer, or take more: kernels whose arguments are the memory that they work on.
EXCEPTIONS = {
    "agents/planning/belief_rollout.py:_stage_cost": "one loop over the lanes: four loops are slower",
    "duffing_env/kernel.py:_define_step_blocks": "the order of a step; taken apart it compiles longer",
    "duffing_env/kernel.py:_define_step_blocks.step_blocks": "the arrays that a step works on",
    "duffing_env/kernel.py:compile_kernel.step_parallel": "the arrays that a step works on",
    "estimator/inference/mean_field.py:_residual_power": "moments of the paper's estimator, number by number",
    "estimator/inference/mean_field.py:begin": "moments of the paper's estimator, number by number",
    "estimator/inference/mean_field.py:free_energy": "moments of the paper's estimator, number by number",
    "estimator/inference/mean_field.py:iterate": "moments of the paper's estimator, number by number",
}


def modules():
    return [
        path
        for package in PACKAGES
        for path in sorted((ROOT / package).rglob("*.py"))
        if "__pycache__" not in path.parts
    ]


def functions(path):
    """Every function of a module, with its name within the module."""

    def visit(node, prefix):
        for child in ast.iter_child_nodes(node):
            name = f"{prefix}{child.name}" if hasattr(child, "name") and not isinstance(child, ast.alias) else prefix
            if isinstance(child, ast.FunctionDef):
                yield f"{path.relative_to(ROOT).as_posix()}:{name}", child
            yield from visit(child, f"{name}." if name != prefix else prefix)

    yield from visit(ast.parse(path.read_text(encoding="utf-8")), "")


def size_faults(function):
    """The limits that a function exceeds."""
    arguments = function.args
    named = [
        a.arg for a in (*arguments.posonlyargs, *arguments.args, *arguments.kwonlyargs) if a.arg not in ("self", "cls")
    ]
    lines = function.end_lineno - function.lineno + 1
    faults = [f"{lines} lines"] if lines > FUNCTION_LINES else []
    return faults + ([f"{len(named)} parameters"] if len(named) > PARAMETERS else [])


def test_no_module_is_too_long():
    lines = {path.relative_to(ROOT).as_posix(): path.read_text(encoding="utf-8").count("\n") for path in modules()}
    assert len(lines) > 100
    assert {name: count for name, count in lines.items() if count > MODULE_LINES} == {}


def test_no_function_is_too_long_but_those_that_are_named():
    faults = {
        name: found for path in modules() for name, function in functions(path) if (found := size_faults(function))
    }
    assert {name: found for name, found in faults.items() if name not in EXCEPTIONS} == {}
    assert sorted(set(EXCEPTIONS) - set(faults)) == [], "these are short enough now: take their names off the list"


@pytest.mark.parametrize(
    ("source", "found"),
    [
        ("def f():\n" + "    pass\n" * 100, ["101 lines"]),
        ("def f(a, b, c, d, e, f, g, h, i, j, k): pass", ["11 parameters"]),
        ("def f(self, a, b, c, d, e, f, g, h, i, j): pass", []),
    ],
)
def test_size_faults_are_found(source, found):
    assert size_faults(ast.parse(source).body[0]) == found
