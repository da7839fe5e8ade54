"""Fuzzing of constructors and functions: one to three arguments are bad values."""

import importlib
import os
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from hypothesis import strategies as st

from agents.hardware.run_settings import RunSettings
from agents.minari_datasets import Config as Dataset
from agents.policies.networks.policy_saving import save_policy
from agents.policies.signal_export import draw_signal
from agents.training.training_config import TrainConfig
from benchmarks.fuzz.bad_values import anything, changed, options
from benchmarks.fuzz.call_verdicts import Call
from benchmarks.fuzz.fuzz_estimators import RIG
from estimator import (
    PEMNARX,
    SILVERBOX_TWIN,
    Belief,
    Channel,
    OnlineEstimator,
    Parameters,
    Rig,
    coefficients_of,
    cramer_rao,
    difference,
    duffing,
    fisher_information,
    identify,
    paper_text_prior,
    published_run_prior,
    recorded_prior,
    relative_covariance,
    save_estimator,
    silverbox_prior,
    to_physical,
    weak_prior,
)
from estimator.models.model import Model
from estimator.priors import gaussian_moments, log_uniform_moments
from estimator.rigs.units import Scales

_DECAY = {
    "name": "decay", "states": {"x": "V"}, "coefficients": {"rate": "1"}, "noise": ("1",), "outputs": {"y": "x"},
    "rates": ("u - rate*x",), "next_state": (), "held": False, "substeps": 1, "physical": {}, "dimensions": {},
    "inverse": {},
}  # fmt: skip
_TWIN = {name: getattr(SILVERBOX_TWIN, name) for name in "mcab"}
_POINT = coefficients_of(difference(), SILVERBOX_TWIN)
_NOISES = {"process_noise": 5e-4, "measurement_noise": 5e-4, "noise_shape": 2.0, "state_std": 1e-3}
_EYE = np.eye(4)

#: Functions to call, by name, with good arguments.
MADE: dict[str, tuple[Callable[..., Any], dict[str, Any]]] = {
    "OnlineEstimator": (
        OnlineEstimator,
        {"model": None, "prior": None, "rig": None, "factorisation": "structured", "iterations": 3,
         "as_published": False, "drift": 0.0, "expectations": "first_order", "noise_hypotheses": 1},
    ),
    "Rig": (Rig, {"step": 1e-3, "interpolation": "linear", "delay": 0, "input": {}, "output": {}, "guess": None}),
    "Channel": (Channel, {"unit": "N", "limit": 1.0, "range": None, "kind": "displacement", "noise": 1.0, "offset": 0}),
    "Scales": (Scales, {"step": 1e-3, "input": 1.0, "output": 1.0, "order": 0, "input_unit": "N", "output_unit": "m"}),
    "Belief": (Belief, {"model": difference(), "record": silverbox_prior().record}),
    "Belief.of": (
        Belief.of,
        {"model": difference(), "mean": np.ones(6), "cov": np.eye(6), "gamma": (2.0, 1.0), "xi": (2.0, 1.0)},
    ),
    "weak_prior": (weak_prior, {"model": difference(), "mean": _POINT, "cov": _EYE, **_NOISES}),
    "silverbox_prior": (silverbox_prior, {"model": difference(), "spread": 0.3, **_NOISES}),
    "recorded_prior": (
        recorded_prior,
        {"model": duffing(), "spread": 0.3, "process_noise": 1e-3, "measurement_noise": 1e-3, "noise_shape": 2.0},
    ),
    "published_run_prior": (published_run_prior, {"nonlinear": True, "model": None}),
    "log_uniform_moments": (log_uniform_moments, {"model": difference(), "center": _TWIN, "spread": 0.3}),
    "gaussian_moments": (gaussian_moments, {"model": difference(), "mean": _TWIN, "std": {"m": 1e-7}}),
    "Model": (Model, _DECAY),
    "difference": (difference, {"preset": "paper"}),
    "duffing": (duffing, {"offsets": True, "sensor": "velocity"}),
    "fisher_information": (
        fisher_information,
        {"model": difference(), "coefficients": _POINT, "u": np.full(5, 0.1), "process_noise": 5e-4,
         "measurement_noise": 5e-4, "interpolation": "zero_order", "state_std": 0.0},
    ),
    "cramer_rao": (cramer_rao, {"information": _EYE, "prior_precision": _EYE}),
    "coefficients_of": (coefficients_of, {"model": difference(), "parameters": _TWIN}),
    "to_physical": (to_physical, {"model": difference(), "coefficients": _POINT}),
    "PEMNARX": (PEMNARX, {"units": 2, "input_delay": 0, "seed": 0, "restarts": 1}),
    "paper_text_prior": (paper_text_prior, {"nonlinear": True, "model": None}),
    "relative_covariance": (relative_covariance, {"model": difference(), "coefficients": _POINT, "covariance": _EYE}),
    "Parameters": (lambda values: Parameters(values), {"values": _TWIN}),
    "identify": (identify, {"rig": RIG, "records": (np.ones(5), np.ones(5))}),  # records that are too short
    "save_estimator": (save_estimator, {"estimator": OnlineEstimator(), "path": "estimator.npz"}),
    "save_policy": (save_policy, {"folder": "policy", "model": 3, "card": None, "normalizer": None}),
    "draw_signal": (draw_signal, {"name": "prbs", "samples": 64, "max_input": 0.15, "max_rms": None, "seed": 0}),
    "Plan": (RunSettings, {name: one.default for name, one in RunSettings.__dataclass_fields__.items()}),
    "Dataset": (Dataset, {"grade": "random", "env": "duffing_env/Short-v0", "episodes": 3, "seed": 0}),
    "TrainConfig": (
        TrainConfig,
        {"algo": "ppo", "env": "duffing_env/Short-v0", "reward": "fisher", "steps": 9, "seed": 0, "options": {},
         "checkpoints": 5, "eval_every": 0, "torch_threads": 1},
    ),
}  # fmt: skip

#: Arguments whose every number compiles a kernel; from 1 to 1,000 they keep their good value.
_COSTLY = {"OnlineEstimator": ("iterations", "noise_hypotheses", "model", "prior")}


def calls() -> st.SearchStrategy[Call]:
    """Calls of constructors and functions."""
    place = Path(tempfile.mkdtemp(prefix="fuzz-")) / "here"  # some functions write files, also to "../x"
    place.mkdir()
    os.chdir(place)
    importlib.import_module("torch")  # an import of seconds within a call would count as a hang

    @st.composite
    def call(draw: st.DrawFn) -> Call:
        if draw(st.integers(0, 9)) == 0:
            described = draw(changed(RIG.to_dict()))
            return Call(
                "Rig.from_any",
                lambda: Rig.from_any(described),
                ("rig", *Rig.__dataclass_fields__, *Channel.__dataclass_fields__),
            )
        if draw(st.integers(0, 19)) == 0:
            value = draw(anything)
            return Call("Rig.shipped", lambda: Rig.shipped(value), ("name",))
        name = draw(st.sampled_from(list(MADE)))
        function, good = MADE[name]
        given = draw(options(good))
        for costly in _COSTLY.get(name, ()):
            number = given[costly]
            if isinstance(number, int | np.integer) and not isinstance(number, bool) and 1 <= number <= 1000:
                given[costly] = good[costly]
        return Call(name, lambda: function(**given), (*given, "record"))

    return call()
