"""Imports go one way: no module imports another that imports it, and each room imports only what stands below it.

Imports within functions and those for type checkers alone count as well.
"""

import ast
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
#: From the ground up; research and benchmarks are in the repository only, and not in the wheel.
PACKAGES = ("estimator", "duffing_env", "agents", "research", "benchmarks")
#: At the top of the repository; they may import all but the benchmarks.
SCRIPTS = ("train", "evaluate", "reproduce")
#: Modules of agents that are commands themselves, besides those in agents.commands.
COMMAND_MODULES = ("agents.cli", "agents.minari_datasets")


def modules(root):
    """Name of every module to its file."""
    paths = [path for package in PACKAGES for path in (root / package).rglob("*.py")]
    paths = [path for path in paths if "__pycache__" not in path.parts]
    paths += [root / f"{name}.py" for name in SCRIPTS if (root / f"{name}.py").exists()]
    names = [".".join(path.relative_to(root).with_suffix("").parts) for path in paths]
    return {name.removesuffix(".__init__"): path for name, path in zip(names, paths, strict=True)}


def imported(name, path, known):
    """The modules of ours that a module imports anywhere in its file."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found.update(alias.name for alias in node.names)
        if isinstance(node, ast.ImportFrom):
            package = name.split(".") if path.name == "__init__.py" else name.split(".")[:-1]
            start = package[: len(package) + 1 - node.level] if node.level else []
            base = ".".join([*start, *([node.module] if node.module else [])])
            found.update(f"{base}.{alias.name}" if f"{base}.{alias.name}" in known else base for alias in node.names)
    return found & known.keys() - {name}


def graph_of(root):
    """Name of every module to the modules that it imports."""
    known = modules(root)
    return {name: imported(name, path, known) for name, path in known.items()}


def within(name, *rooms):
    return any(name == room or name.startswith(f"{room}.") for room in rooms)


def circle(graph):
    """Modules that import each other in turn; none where there are no such."""
    try:
        list(TopologicalSorter(graph).static_order())
    except CycleError as error:
        return error.args[1]
    return []


def upward(name, other):
    """A package imports one above it, or anything imports the benchmarks, or a package imports a script."""

    def floor(module):
        place = module.split(".")[0]
        return PACKAGES.index(place) if place in PACKAGES else PACKAGES.index("research") + 0.5

    return floor(other) > floor(name)


def uninstalled(name, other):
    """What is installed imports research, which is not."""
    return within(other, "research") and not within(name, "research", "benchmarks", "reproduce")


def policy_in_planning(name, other):
    """Planning imports another room of agents, such as a policy."""
    return within(name, "agents.planning") and within(other, "agents") and not within(other, "agents.planning")


def commands_below(name, other):
    """A library module of agents imports the command line."""
    is_library = within(name, "agents") and not within(name, "agents.commands", *COMMAND_MODULES)
    return is_library and within(other, "agents.commands", *COMMAND_MODULES)


RULES = {rule.__name__: rule for rule in (upward, uninstalled, policy_in_planning, commands_below)}


def broken(rule, graph):
    """Imports that break a rule."""
    return sorted(f"{name} imports {other}" for name, others in graph.items() for other in others if rule(name, other))


@pytest.fixture(scope="module")
def graph():
    found = graph_of(ROOT)
    assert len(found) > 200
    return found


def test_no_module_imports_one_that_imports_it(graph):
    found = circle(graph)
    assert not found, f"these import each other: {' -> '.join(found)}"


@pytest.mark.parametrize("rule", RULES)
def test_imports_keep_to_the_rule(rule, graph):
    assert broken(RULES[rule], graph) == []


def plant(root, files):
    for name, text in files.items():
        path = root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    return graph_of(root)


@pytest.mark.parametrize(
    "text",
    [
        "import estimator.b",
        "from estimator import b",
        "from . import b",
        "from .b import x",
        "def f():\n    from estimator.b import x",
        "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    from estimator.b import x",
    ],
)
def test_a_circle_is_found_wherever_the_import_stands(text, tmp_path):
    files = {"estimator/__init__.py": "", "estimator/a.py": text, "estimator/b.py": "from estimator.a import y"}
    assert set(circle(plant(tmp_path, files))) == {"estimator.a", "estimator.b"}
    assert circle(plant(tmp_path, {"estimator/b.py": ""})) == []


@pytest.mark.parametrize(
    ("rule", "name", "other"),
    [
        ("upward", "estimator/a.py", "duffing_env.b"),
        ("upward", "research/a.py", "benchmarks.b"),
        ("upward", "reproduce.py", "benchmarks.b"),
        ("upward", "agents/a.py", "train"),
        ("uninstalled", "agents/a.py", "research.b"),
        ("uninstalled", "evaluate.py", "research.b"),
        ("policy_in_planning", "agents/planning/a.py", "agents.policies"),
        ("policy_in_planning", "agents/planning/a.py", "agents.predict_argument_checks"),
        ("commands_below", "agents/training/a.py", "agents.cli"),
        ("commands_below", "agents/policies/a.py", "agents.commands.b"),
    ],
)
def test_each_rule_can_be_broken(rule, name, other, tmp_path):
    files = {f"{other.replace('.', '/')}.py": "", name: f"def f():\n    import {other}"}
    assert broken(RULES[rule], plant(tmp_path, files)) == [
        f"{name.removesuffix('.py').replace('/', '.')} imports {other}"
    ]
    assert broken(RULES[rule], plant(tmp_path, {name: ""})) == []
