"""Fuzzing of online estimators: every method with series of any scale, or with bad values."""

import pickle
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
from hypothesis import strategies as st

from benchmarks.fuzz.bad_values import another_array, anything
from benchmarks.fuzz.call_verdicts import Call
from estimator import Channel, OnlineEstimator, Rig, difference, duffing, silverbox_prior
from estimator.belief import check_belief_record

#: Guess of m [kg], c [N·s/m], a [N/m] and b [N/m³].
_GUESS = {"m": (0.3, 0.5), "c": (0.4, 0.8), "a": (2e3, 3e3), "b": (2e7, 6e7)}
RIG = Rig(1e-3, input=Channel("N", limit=6.0), output=Channel("m", range=0.03, noise=5e-6), guess=_GUESS)

_ODE = duffing()

#: Estimators to call, by name.
MADE: dict[str, Callable[[], OnlineEstimator]] = {
    "paper": OnlineEstimator,
    "mean field": lambda: OnlineEstimator(factorisation="mean_field"),
    "drift": lambda: OnlineEstimator(difference(), drift=0.01),
    "look-ahead": lambda: OnlineEstimator(_ODE, silverbox_prior(_ODE), Rig.silverbox("look_ahead")),
    "spline": lambda: OnlineEstimator(_ODE, silverbox_prior(_ODE), Rig.silverbox("spline")),
    "sigma points": lambda: OnlineEstimator(_ODE, silverbox_prior(_ODE), expectations="sigma_points"),
    "ensemble": lambda: OnlineEstimator(noise_hypotheses=9),
    "rig": lambda: OnlineEstimator(rig=RIG),
}


def started_estimator(name: str) -> OnlineEstimator:
    """An estimator after twelve samples."""
    estimator, rng = MADE[name](), np.random.default_rng(0)
    scale = estimator.scales
    estimator.run(0.1 * scale.input * rng.standard_normal(12), 0.01 * scale.output * rng.standard_normal(12))
    return estimator


def _state(estimator: OnlineEstimator) -> Any:
    return estimator.arrays(), estimator.free_energies, estimator.forecasts


def sound(estimator: OnlineEstimator) -> str:
    """What is wrong with an estimator's belief; empty where nothing is."""
    try:
        check_belief_record("belief", estimator.model, estimator.belief.record, 1e-5)
    except ValueError as error:
        return str(error).split(",")[0]
    return ""


@contextmanager
def suppress_overflow() -> Iterator[None]:
    """Let the error pass that says that a belief overflowed: a sound belief may overflow later."""
    try:
        yield
    except ValueError as error:
        if "overflowed" not in str(error):
            raise


def calls() -> st.SearchStrategy[Call]:
    """Calls of an estimator's methods."""
    pool = {name: pickle.dumps(started_estimator(name)) for name in MADE}
    arrays = {name: started_estimator(name).arrays() for name in MADE}

    @st.composite
    def series(draw: st.DrawFn, size: int) -> Any:
        if draw(st.integers(0, 3)) == 0:
            return draw(anything)
        scale = 10.0 ** draw(st.sampled_from([-300, -30, -9, -3, -2, -1, 0, 0, 1, 2, 4, 9, 30, 100, 200, 300]))
        values = scale * np.array(draw(st.lists(st.floats(-1, 1), min_size=size, max_size=size)))
        if size and draw(st.integers(0, 4)) == 0:
            values[draw(st.integers(0, size - 1))] = draw(st.sampled_from([np.nan, np.inf, -np.inf, 1e308]))
        return values

    @st.composite
    def call(draw: st.DrawFn) -> Call:
        name = draw(st.sampled_from(list(MADE)))
        estimator: OnlineEstimator = pickle.loads(pool[name])
        method = draw(st.sampled_from(["update", "run", "run", "predict", "forecast", "simulate", "restore", "belief"]))
        data: Any = None
        names: tuple[str, ...] = ("u", "y", "missing", "interpolation", "y_init")
        if method == "update":
            u, y = draw(series(1)), draw(series(1))
            values = [v[0] if isinstance(v, np.ndarray) and v.shape == (1,) else v for v in (u, y)]
            function = lambda: estimator.update(*values)  # noqa: E731
        elif method == "restore":
            key = draw(st.sampled_from(sorted(arrays[name])))
            given = {**arrays[name], key: draw(st.one_of(another_array(arrays[name][key]), anything))}
            if draw(st.integers(0, 5)) == 0:
                del given[draw(st.sampled_from(sorted(given)))]
            names = ("arrays", *given)

            def function() -> None:
                estimator.restore(given)
                scale = estimator.scales
                with suppress_overflow():
                    estimator.run(np.full(12, 0.1 * scale.input), np.full(12, 0.01 * scale.output))
        elif method == "belief":
            value, names = draw(anything), ("coefficients", "probability", "mean", "cov")
            asked = draw(st.sampled_from(["log_prob", "interval"]))
            function = lambda: getattr(estimator.belief, asked)(value)  # noqa: E731
        else:
            size = draw(st.integers(0, 12))
            other = size if draw(st.integers(0, 5)) else draw(st.integers(0, 12))
            u, y = draw(series(size)), draw(series(other))
            data = (u, y)
            more = {"missing": True} if method == "run" and draw(st.booleans()) else {}
            function = lambda: getattr(estimator, method)(u, y, **more)  # noqa: E731
        return Call(
            f"{name}: {method}", function, names, lambda: _state(estimator), lambda result: sound(estimator), data
        )

    return call()
