"""Imports go one way: no module imports another that imports it, and none one that stands above it."""

import ast
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
#: From the ground up; the scripts at the top of the repository may import all but the benchmarks.
FLOORS = ("estimator", "duffing_env", "agents", "research", "benchmarks")
SCRIPTS = ("train", "evaluate", "reproduce")


def modules():
    """Name of every module to its file."""
    paths = [path for floor in FLOORS for path in (ROOT / floor).rglob("*.py") if path.parent.name != "__pycache__"]
    paths += [ROOT / f"{name}.py" for name in SCRIPTS]
    names = [".".join(path.relative_to(ROOT).with_suffix("").parts) for path in paths]
    return {name.removesuffix(".__init__"): path for name, path in zip(names, paths, strict=True)}


def imported(name, path, known):
    """The modules of ours that a module imports, also within its functions, but not for type checkers alone."""
    found = set()

    def visit(node):
        for child in ast.iter_child_nodes(node):
            if isinstance(child, ast.If) and "TYPE_CHECKING" in ast.unparse(child.test):
                continue
            if isinstance(child, ast.Import):
                found.update(alias.name for alias in child.names)
            if isinstance(child, ast.ImportFrom):
                package = name.split(".") if path.name == "__init__.py" else name.split(".")[:-1]
                start = package[: len(package) + 1 - child.level] if child.level else []
                base = ".".join([*start, *([child.module] if child.module else [])])
                found.update(
                    f"{base}.{alias.name}" if f"{base}.{alias.name}" in known else base for alias in child.names
                )
            visit(child)

    visit(ast.parse(path.read_text(encoding="utf-8")))
    return found & known.keys() - {name}


@pytest.fixture(scope="module")
def graph():
    known = modules()
    return {name: imported(name, path, known) for name, path in known.items()}


def test_no_module_imports_one_that_imports_it(graph):
    assert len(graph) > 100
    try:
        list(TopologicalSorter(graph).static_order())
    except CycleError as error:
        pytest.fail(f"these import each other: {' -> '.join(error.args[1])}")


def test_no_module_imports_one_that_stands_above_it(graph):
    def floor_of(name):
        place = name.split(".")[0]
        return FLOORS.index(place) if place in FLOORS else FLOORS.index("agents") + 0.5

    upward = [f"{name} imports {other}" for name, others in graph.items() for other in others
              if floor_of(other) > floor_of(name)]  # fmt: skip
    assert upward == []


def test_the_benchmarks_are_imported_by_nobody(graph):
    users = {name for name, others in graph.items() if any(other.startswith("benchmarks") for other in others)}
    assert {name for name in users if not name.startswith("benchmarks")} == set()
