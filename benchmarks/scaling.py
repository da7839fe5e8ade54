"""Section 4b: how the cost of an env-step grows with environments, iterations, horizon and threads; one figure."""

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym

from agents.evaluation.figures import new_figure, save_png
from benchmarks.environments import TRACK, vector_steps
from benchmarks.section_tables import Claim, Section, ratio
from benchmarks.timed_rounds import CORES, Result, Row, later, measure, timed
from estimator.support.update_options import DEFAULT_ITERATIONS

#: Unit of the rows.
UNIT = "ns/env-step"

#: Environments, where these are not the axis.
SIZE = 1024

#: Samples of an episode, where these are not the axis.
HORIZON = 256

#: Label and values of each axis, by option.
AXES: dict[str, tuple[str, Sequence[int]]] = {
    "num_envs": ("environments", (1, 4, 16, 64, 256, 1024, 4096, 16384)),
    "iterations": ("iterations", (1, 2, 3, 5, 10, 20)),
    "horizon": ("samples of an episode", (16, 64, 256, 1024)),
    "threads": ("threads", range(1, CORES + 1)),
}

#: Colour of each factorisation.
_COLOURS = {"structured": "#0072b2", "mean_field": "#d55e00"}


def run(repetitions: int, on_row: Callable[[str], None], figure: Path) -> Section:
    """Time whole steps through ``make_vec`` along each axis, the others at their defaults, and draw the figure."""
    rows = [
        Row(_name(axis, value, rule), UNIT, later(partial(_steps, axis, value, rule)), at_least=0.1)
        for axis, (_, values) in AXES.items()
        for value in values
        for rule in DEFAULT_ITERATIONS
    ]
    results = measure(rows, repetitions, on_row)
    draw(results, figure)
    claims = [
        Claim(f"cost of an env-step, {rule.replace('_', ' ')}: {text}", ratio(results[first], results[last]))
        for rule in DEFAULT_ITERATIONS
        for text, first, last in (
            (f"1 thread over {CORES}, at {SIZE}", _name("threads", 1, rule), _name("threads", CORES, rule)),
            ("20 iterations over 1", _name("iterations", 20, rule), _name("iterations", 1, rule)),
            ("at 16384 over at 1024", _name("num_envs", 16384, rule), _name("num_envs", 1024, rule)),
        )
    ]
    notes = [
        f"Through make_vec; {SIZE} environments, one thread, {HORIZON} samples, 3 or 10 iterations, unless an axis "
        "says otherwise. Ends of episodes, where beliefs are returned, are included."
    ]
    return Section("Scaling", list(results.values()), claims, notes)


def _name(axis: str, value: int, rule: str) -> str:
    return f"{AXES[axis][0]} {value}, {rule.replace('_', ' ')}"


def _steps(axis: str, value: int, rule: str) -> Callable[[int], tuple[float, float]]:
    options: dict[str, Any] = {"num_envs": SIZE, "horizon": HORIZON, axis: value}
    envs = gym.make_vec(TRACK, vectorization_mode="vector_entry_point", factorisation=rule, **options)
    return timed(vector_steps(envs, options["horizon"]))


def draw(results: dict[str, Result], path: Path) -> None:
    """One panel per axis: median cost, with a band from minimum to maximum."""
    figure = new_figure(10, 6.4)
    for panel, (axis, (label, values)) in zip(figure.subplots(2, 2).flat, AXES.items(), strict=True):
        for rule, colour in _COLOURS.items():
            found = [(value, results[_name(axis, value, rule)]) for value in values]
            found = [(value, result) for value, result in found if result.values]
            x = [value for value, _ in found]
            panel.fill_between(
                x, [min(r.values) for _, r in found], [max(r.values) for _, r in found], color=colour, alpha=0.2, lw=0
            )
            panel.plot(x, [r.median for _, r in found], "o-", color=colour, ms=4, label=rule.replace("_", " "))
        if axis == "threads":
            panel.set_xticks(values)
        else:
            panel.set_xscale("log", base=2)
            panel.set_xticks(values, [f"{value:,}" for value in values])
        panel.minorticks_off()
        if axis == "num_envs":
            panel.set_yscale("log")
        else:
            panel.set_ylim(0, None)
        panel.set_xlabel(label)
        panel.set_ylabel("ns per env-step")
        panel.grid(alpha=0.3)
        panel.legend()
    save_png(figure, path)
