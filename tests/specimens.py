"""One model and one environment of every kind, shared by the tests because a kernel takes seconds to compile.

`SPECIMENS` are the equations that all that works for any model is tried on.

Every environment of the list has another `duffing_env.storage.kernel_spec.KernelSpec`, except for the last ones, which
share the first one's and differ in run-time parameters. Episodes are short, so that random actions end some at the
limit and some at the horizon.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np
import pytest
from playing import random_actions
from reference.plants import ASYMMETRIC_SPRING, BOUC_WEN, DOUBLE_PENDULUM, DRAG, DRY_FRICTION, LAG, TWO_MASSES

from duffing_env.env import DuffingEnv
from duffing_env.tracks.differential_equation_tracks import ContinuousEnv, ContinuousVectorEnv
from duffing_env.tracks.model_env import ModelEnv, ModelVectorEnv
from duffing_env.tracks.rig_env import RigEnv, RigVectorEnv
from duffing_env.tracks.silverbox_replay import SilverboxReplayEnv, SilverboxReplayVectorEnv
from duffing_env.vector_env import DuffingVectorEnv
from estimator import Channel, Rig
from estimator.models.difference_equation import difference
from estimator.models.duffing import duffing
from estimator.models.pendulum import PENDULUM
from estimator.priors import silverbox_prior
from estimator.rigs.silverbox_constants import SILVERBOX_SAMPLING_STEP

# --- Models --------------------------------------------------------------------------------------------------------

#: A model of one's own: a bend, and two sensors.
SEEN_TWICE = replace(DRAG, name="drag_seen_twice", outputs={"y": "x", "speed": "v"})

#: In newtons and metres.
RIG = Rig(
    1e-3, input=Channel("N", limit=6, noise=0.02), output=Channel("m", range=0.03, noise=5e-6),
    guess={"m": (0.3, 0.5), "c": (0.4, 0.8), "a": (2e3, 3e3), "b": (2e7, 6e7)},
)  # fmt: skip
#: In volts, as the tracks are, so that the same numbers go into the same estimator.
VOLTS = Rig(SILVERBOX_SAMPLING_STEP, input=Channel("V", limit=1.0), output=Channel("V", range=1.0))

MODELS = {
    "difference": difference(),
    "linear difference": difference("linear"),
    "cubic difference": difference("cubic"),
    "duffing": duffing(),
    "rig": RIG.model,
    "pendulum": PENDULUM,
    "own": SEEN_TWICE,
}

# --- Plants --------------------------------------------------------------------------------------------------------


class Difference:
    """Eq. (2) without noise, for `VOLTS`; it records its calls."""

    def __init__(self):
        self.inputs, self.resets = [], 0

    def reset(self):
        self.x = self.last = 0.0
        self.resets += 1

    def step(self, u):
        self.inputs.append(u)
        self.x, self.last = 1.5 * self.x - 1.4 * self.x**3 - 0.95 * self.last + 0.4 * u, self.x
        return self.x


class Bench:
    """Eq. (1) without noise in newtons and metres, for `RIG`, by the midpoint rule; it records inputs and outputs."""

    truth = {"m": 0.42, "c": 0.5, "a": 2400.0, "b": 4e7}  # noqa: RUF012

    def reset(self):
        self.x = self.v = 0.0
        self.inputs, self.outputs = [], []

    def step(self, u):
        m, c, a, b = self.truth.values()
        self.inputs.append(u)
        for _ in range(20):
            x, v = self.x + 2.5e-5 * self.v, self.v + 2.5e-5 * (u - c * self.v - a * self.x - b * self.x**3) / m
            self.x, self.v = self.x + 5e-5 * v, self.v + 5e-5 * (u - c * v - a * x - b * x**3) / m
        self.outputs.append(self.x)
        return self.x


def around(plant, factorisation="structured", **options):
    """`VOLTS` around a plant, with the estimator of Amplitude-v0."""
    usual = {
        "prior": silverbox_prior().with_factorisation(factorisation),
        "noise_hypotheses": 1,
        "reward": "free_energy",
    }
    usual |= {"max_input": 0.15, "max_output": 0.6, "factorisation": factorisation}
    return RigEnv(rig=VOLTS, plant=plant, **usual | options)


def around_difference(**options):
    """`around` a new `Difference`."""
    return around(Difference(), **options)


def around_bench(**options):
    """`RIG` around a new `Bench`."""
    return RigEnv(rig=RIG, plant=Bench(), **options)


# --- The record ----------------------------------------------------------------------------------------------------


def on_the_record(envs, actions):
    """The recorded inputs in parts of the largest, for any actions up to 1; an action beyond 1 leaves the record."""
    played = np.minimum(envs._batch.row_values("ELAPSED_SAMPLES").astype(int), envs.horizon - 1)
    recorded = envs.recorded_input[played] / envs.max_input
    return (recorded + np.where(np.abs(np.ravel(actions)) > 1, 0.1, 0.0)).astype(np.float32)


class OnTheRecord(SilverboxReplayEnv):
    """Replaces random actions by the record's inputs."""

    def step(self, action):
        return super().step(on_the_record(self, action))


class OnTheRecordVector(SilverboxReplayVectorEnv):
    """Many of them."""

    single_env_class = OnTheRecord

    def step(self, actions):
        return super().step(on_the_record(self, actions)[:, None])


# --- Observations and rewards of one's own -------------------------------------------------------------------------


def means(beliefs):
    """An observation: means of the coefficients, and logarithms of their standard deviations."""
    stds = np.sqrt(np.diagonal(beliefs.coefficients_cov, axis1=1, axis2=2))
    return np.concatenate([beliefs.coefficients_mean, np.log(stds)], axis=1)


def all_that_is_given(before, after, u, y, truth):
    """A reward that uses all its arguments."""
    return after.mean[:, 0] + before.noises[:, 0] + u + y + truth.m + truth["b"]


# --- Environments --------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Environment:
    """How an environment is made.

    Attributes:
        name: for the test's name.
        single_env_class: makes one.
        vector: makes some; None where there is no such.
        options: of both.
        sums: whether a held action gives the sum of what its samples give.
        inputs: number of its inputs.
    """

    name: str
    single_env_class: Callable[..., Any]
    vector: Callable[..., Any] | None
    options: dict[str, Any] = field(default_factory=dict)
    sums: bool = True
    inputs: int = 1

    def random_actions(self, steps, rows=1, seed=0):
        return random_actions(steps, rows, seed, self.inputs)

    def make(self, **options):
        return self.single_env_class(**self.options | options)

    def make_vec(self, rows, **options):
        return self.vector(rows, **self.options | options)

    @property
    def on_record(self):
        return self.single_env_class is OnTheRecord

    @property
    def has_plant(self):
        return self.single_env_class in (around_difference, around_bench)


TIGHT = {"horizon": 22, "max_output": 0.22}
GUESSED = {"noise_hypotheses": 3, "process_noise_guess": 1.5e-3, "noise_range": 10.0}
KNOWN = {"noise_range": 1.0, "noise_hypotheses": 1}

#: Two masses, whose forces have limits of their own and one budget, which ends before the episode.
TWO_FORCES = {
    "system": TWO_MASSES, "mean": {"stiffness": 0.3, "coupling": 0.1, "drag": 0.1, "gain": 0.3}, "spread": 0.2,
    "process_noise": 1e-3, "measurement_noise": 1e-3, "sensor_noise": (2e-3,), "max_input": {"f1": 0.5, "f2": 0.2},
    "max_slew": (0.6, 0.15), "max_rms": 0.25, "input_cost": 0.1, "max_output": 0.5, "horizon": 22,
}  # fmt: skip

#: The Silverbox circuit's middle, for models with its parameters.
_CIRCUIT = {"m": 6.4568e-6, "c": 2.5717e-4, "a": 1.1747, "b": 3.7672}

_OSCILLATOR = {"stiffness": 0.3, "damping": 0.1, "gain": 0.3}

#: Equations of every sort, with the middle of their coefficients and limits at which some episodes end early.
SPECIMENS: dict[str, dict[str, Any]] = {
    "paper": {
        "system": difference(), "mean": _CIRCUIT, "sampling_step": SILVERBOX_SAMPLING_STEP, "process_noise": 5e-4,
        "measurement_noise": 5e-4, "max_input": 0.15, "max_output": 0.22,
    },
    "offsets": {
        "system": duffing(offsets=True), "mean": _CIRCUIT | {"u0": 0.0, "y0": 0.0},
        "std": {"m": 6e-7, "c": 3e-5, "a": 0.12, "b": 0.4, "u0": 0.02, "y0": 0.02},
        "sampling_step": SILVERBOX_SAMPLING_STEP, "process_noise": 5e-4, "measurement_noise": 5e-4, "max_input": 0.15,
        "max_output": 0.22,
    },
    "asymmetric spring": {"system": ASYMMETRIC_SPRING, "mean": _OSCILLATOR | {"quadratic": 0.2, "cubic": 0.3}},
    "dry friction": {"system": DRY_FRICTION, "mean": _OSCILLATOR | {"friction": 0.03}, "max_output": 0.35},
    "Bouc-Wen": {"system": BOUC_WEN, "mean": _OSCILLATOR | {"stiffness": 0.2, "hysteresis": 0.2, "loss": 1.0}},
    "two masses": {"system": TWO_MASSES, "mean": {"stiffness": 0.3, "coupling": 0.1, "drag": 0.1, "gain": 0.3}},
    "double pendulum": {
        "system": DOUBLE_PENDULUM, "mean": {"m1": 1.0, "m2": 1.0, "l1": 1.0, "l2": 1.0}, "sampling_step": 0.05,
        "process_noise": 1e-2, "measurement_noise": 1e-2, "max_input": {"t1": 16.0, "t2": 8.0}, "max_output": 0.6,
    },
    "Wiener-Hammerstein": {
        "system": "wiener_hammerstein", "mean": {"stiffness": 0.5, "damping": 0.15, "cubic": 1.0, "decay": 0.4},
    },
    "lag": {"system": LAG, "mean": {"decay": 0.2, "gain": 0.2}, "max_output": 0.2},
}  # fmt: skip
for _options in SPECIMENS.values():
    _options |= {"noise_range": 10.0, "noise_hypotheses": (5, 5), "horizon": 22}
    for _name, _value in (
        ("process_noise", 1e-3),
        ("measurement_noise", 1e-3),
        ("max_input", 0.5),
        ("max_output", 0.5),
    ):
        _options.setdefault(_name, _value)

difference_env = partial(Environment, single_env_class=DuffingEnv, vector=DuffingVectorEnv)
continuous_env = partial(Environment, single_env_class=ContinuousEnv, vector=ContinuousVectorEnv)
replay_env = partial(Environment, single_env_class=OnTheRecord, vector=OnTheRecordVector, sums=False)


def _specimen(name):
    inputs = 2 if name in ("two masses", "double pendulum") else 1
    return Environment(name, ModelEnv, ModelVectorEnv, SPECIMENS[name], inputs=inputs)


#: Another kernel each.
COMPILED = [
    difference_env("difference", options=TIGHT),
    difference_env(
        "fisher", options={"reward": "fisher", "max_output": 1e300, "spread": 0.9, "horizon": 60,
                           "terminated_return": -5.0},
    ),
    difference_env(
        "expected free energy",
        options=TIGHT | {"reward": "expected_free_energy", "noise_range": 10.0, "terminal": True},
    ),
    difference_env("simulation error", options=TIGHT | {"reward": "simulation_error", "jump": 0.3, "drift": 0.01}),
    difference_env("hypotheses", options=TIGHT | GUESSED | {"reward": "free_energy"}),
    difference_env("mean field", options=TIGHT | {"reward": "free_energy", "factorisation": "mean_field"}),
    continuous_env("continuous", options=TIGHT | KNOWN | {"reward": "expected_free_energy"}),
    continuous_env(
        "continuous hypotheses", options=TIGHT | {"noise_hypotheses": 3, "reward": "parameter_error", "max_slew": 0.1},
    ),
    continuous_env("nlarx", options=TIGHT | KNOWN | {"estimator": "nlarx", "iterations": 1, "reward": "log_posterior"}),
    replay_env("replay", options={"reward": "free_energy", "max_output": 0.6}),
    replay_env(
        "linear mean field replay",
        options={"reward": "free_energy", "factorisation": "mean_field", "nonlinear": False},
    ),
    Environment("rig", RigEnv, RigVectorEnv, {"rig": RIG, "noise_hypotheses": 3, "max_output": 0.045, "horizon": 22}),
    Environment("bench", around_bench, None, {"noise_hypotheses": 3, "max_output": 0.045, "horizon": 22}),
    Environment("plant", around_difference, None, {"max_output": 0.2, "horizon": 22}),
    Environment("own model", ModelEnv, ModelVectorEnv, {
        "system": SEEN_TWICE, "mean": {"stiffness": 0.3, "drag": 0.1, "gain": 0.3}, "spread": 0.2,
        "process_noise": 1e-6, "measurement_noise": 1e-4, "sensor_noise": (3e-4,), "max_input": 0.5,
        "max_output": 0.7, "horizon": 22,
    }),
    Environment("two inputs", ModelEnv, ModelVectorEnv, TWO_FORCES, inputs=2),
    *(_specimen(name) for name in SPECIMENS if name != "offsets"),
]  # fmt: skip

#: Environments with the first one's kernel, or the rig's, and other run-time parameters.
ENVIRONMENTS = [
    *COMPILED,
    difference_env(
        "limits", options=TIGHT | {"max_rms": 0.06, "max_slew": 0.04, "input_cost": 0.3, "reward": "log_posterior",
                                   "max_output": 0.14},
    ),
    difference_env("history", options=TIGHT | {"observation": "history", "history": 3}, sums=False),
    difference_env("privileged", options=TIGHT | {"observation": "privileged", "reward": "parameter_error"}),
    _specimen("offsets"),
    difference_env("own functions", options=TIGHT | {"observation": means, "reward": all_that_is_given}, sums=False),
]  # fmt: skip


def each(chosen=lambda environment: True, of=ENVIRONMENTS):
    """Parameters of a test: the environments that are chosen."""
    return [pytest.param(environment, id=environment.name) for environment in of if chosen(environment)]


#: Those that can be many at once.
VECTORS = each(lambda environment: environment.vector is not None)
