"""The official protocol of the Silverbox benchmark, for every estimator of this project.

As `nonlinear_benchmarks` defines it: a model is identified on the first 75 % of the multisine section. From the inputs
and the first 50 outputs of three test signals (the rest of the multisine; the arrow; the arrow without the part whose
amplitude exceeds the training's) it simulates the other outputs, and the root mean square of the errors counts. No
setting may be chosen on test data: `research.studies.silverbox_results.compare_on_validation` compares settings on the
last quarter of the training section.

``docs/evidence/silverbox.md`` discusses the outcome.
"""

from __future__ import annotations

from collections.abc import Mapping
from copy import deepcopy
from dataclasses import dataclass
from time import perf_counter

import numpy as np

from duffing_env.plants.silverbox_record import Regime, SilverboxRecord
from estimator import Model, OnlineEstimator, Rig, difference, duffing, published_run_prior, silverbox_prior
from estimator.belief import Belief
from estimator.rigs.rig_prior import STDS_PER_90_PERCENT
from estimator.support.array_types import FloatArray

MULTISINE = slice(40_650, 127_400)
TRAINING_SAMPLES = 65_062
ARROW = slice(100, 40_575)
WITHOUT_EXTRAPOLATION = 32_000

N_GIVEN_OUTPUTS = 50
"""First outputs of a test signal that a simulation may use, and whose errors do not count."""

TESTS = ("multisine", "arrow", "no_extrapolation")
"""In the order of the submission line."""

TRAINING_LENGTHS = (50, 100, 200, 300, 500, 1_000, 2_000, 5_000, 20_000, TRAINING_SAMPLES)
"""Training samples after which the learning curve has a point."""

CLOSE_ERROR = 1e-3
"""Simulation error on the arrow [V] that the learning curve is timed by."""

N_TIMINGS = 3


@dataclass(frozen=True)
class IdentificationSetting:
    """The settings of one identification.

    Attributes:
        model: equation to identify.
        rig: description of how the inputs act.
        prior: prior; None is the model's default.
        factorisation: ``structured`` or ``mean_field``.
        as_published: whether the published run's two departures from the derived messages apply.
        passes: passes through the training section; an identification with more than one is not online.
        noise_hypotheses: number of noise ratios that are weighted by their evidence.
    """

    model: Model
    rig: Rig
    prior: Belief | None = None
    factorisation: str = "structured"
    as_published: bool = False
    passes: int = 1
    noise_hypotheses: int = 1

    def estimator(self) -> OnlineEstimator:
        """An estimator before its first sample."""
        return OnlineEstimator(
            self.model, self.prior, self.rig, factorisation=self.factorisation, as_published=self.as_published,
            noise_hypotheses=self.noise_hypotheses,
        )  # fmt: skip


def _duffing_setting(
    interpolation: str, feedthrough: bool = True, cubic_damping: bool = False, passes: int = 1
) -> IdentificationSetting:
    """Eq. (1) with both offsets, and noise that is an acceleration held over a sample."""
    model = duffing(offsets=True, feedthrough=feedthrough, cubic_damping=cubic_damping, noise="held")
    return IdentificationSetting(model, Rig.silverbox(interpolation), passes=passes)


#: A difference equation with one tap, whose input acts a sample later; and one with several taps.
_ONE_TAP, _MODEL_TAPS = Rig.silverbox("zero_order", 1), Rig.silverbox("zero_order", 0)

_PUBLISHED = published_run_prior()

SETTINGS = {
    "paper as published": IdentificationSetting(difference(), _MODEL_TAPS, _PUBLISHED, "mean_field", as_published=True),
    "paper, delay 1": IdentificationSetting(difference(), _ONE_TAP, _PUBLISHED, "mean_field"),
    "paper structured": IdentificationSetting(
        difference(), _ONE_TAP, silverbox_prior(state_std=0.1)
    ),  # the record begins in motion
    "NLARX offset": IdentificationSetting(difference("offset"), _ONE_TAP),
    "NLARX three-tap": IdentificationSetting(difference("three-tap"), _MODEL_TAPS),
    "NLARX three-tap, 9 ratios": IdentificationSetting(difference("three-tap"), _MODEL_TAPS, noise_hypotheses=9),
    "NLARX cubic": IdentificationSetting(difference("cubic"), _MODEL_TAPS),
    "ODE linear, d = 0": _duffing_setting("linear", feedthrough=False),
    "ODE linear": _duffing_setting("linear"),
    "ODE linear +e": _duffing_setting("linear", cubic_damping=True),
    "ODE look-ahead": _duffing_setting("look_ahead"),
    "ODE look-ahead +e": _duffing_setting("look_ahead", cubic_damping=True),
    "ODE spline, d = 0": _duffing_setting("spline", feedthrough=False),
    "ODE spline": _duffing_setting("spline"),
    "ODE spline +e": _duffing_setting("spline", cubic_damping=True),
    "ODE spline, 2 passes": _duffing_setting("spline", passes=2),
    "ODE spline +e, 2 passes": _duffing_setting("spline", cubic_damping=True, passes=2),
}


@dataclass(frozen=True)
class Sections:
    """The record as the protocol cuts it."""

    training: Regime
    multisine: Regime
    arrow: Regime
    no_extrapolation: Regime


@dataclass(frozen=True, eq=False)
class ProtocolOutcome:
    """The results of one setting.

    Attributes:
        rmse: root mean square simulation error by test [V].
        prediction_rmse: root mean square one-step prediction error of the multisine test, at the posterior means [V].
        coverage: fraction of the multisine test within the 90 % intervals of its forecasts, while the estimator
            continues to learn; NaN in mean field, which makes no forecasts.
        seconds: training time for each sample and pass [s], without compilation.
        free_energy: free energy accumulated over the first pass [nats].
        learning: simulation error on the arrow [V] after each number of training samples.
        beliefs: posterior after each number of training samples.
        arrow_error: (T,) simulated minus measured arrow [V].
    """

    rmse: dict[str, float]
    prediction_rmse: float
    coverage: float
    seconds: float
    free_energy: float
    learning: dict[int, float]
    beliefs: dict[int, Belief]
    arrow_error: FloatArray


def split_record(record: SilverboxRecord) -> Sections:
    """The training section, and the three tests."""

    def section(name: str, start: int, stop: int) -> Regime:
        return Regime(name, record.u[start:stop], record.y[start:stop])

    end_of_training = MULTISINE.start + TRAINING_SAMPLES
    return Sections(
        section("training", MULTISINE.start, end_of_training),
        section("multisine", end_of_training, MULTISINE.stop),
        section("arrow", ARROW.start, ARROW.stop),
        section("no_extrapolation", ARROW.start, ARROW.start + WITHOUT_EXTRAPOLATION),
    )


def evaluate(setting: IdentificationSetting, sections: Sections) -> ProtocolOutcome:
    """Identifies on the training section and on its beginnings, and evaluates the results on the tests."""
    training = sections.training
    learning, beliefs = {}, {}
    for samples in TRAINING_LENGTHS:
        estimator, free_energy, seconds = identify(setting, training, samples)
        learning[samples] = rmse(simulation_error(estimator, sections.arrow))
        beliefs[samples] = estimator.belief
    for _ in range(N_TIMINGS - 1):
        seconds = min(seconds, identify(setting, training, len(training.y))[2])
    test = sections.multisine
    return ProtocolOutcome(
        rmse={name: rmse(simulation_error(estimator, getattr(sections, name))) for name in TESTS},
        prediction_rmse=rmse(estimator.predict(test.u, test.y) - test.y),
        coverage=coverage(estimator, training, test),
        seconds=seconds,
        free_energy=free_energy,
        learning=learning,
        beliefs=beliefs,
        arrow_error=simulation_error(estimator, sections.arrow),
    )


def identify(setting: IdentificationSetting, training: Regime, samples: int) -> tuple[OnlineEstimator, float, float]:
    """An estimator after the first training samples, its free energy [nats], and the time per sample [s]."""
    u, y = training.u[:samples], training.y[:samples]
    estimator = setting.estimator()
    start = perf_counter()
    free_energy = float(estimator.run(u, y)[:, -1].sum())
    for _ in range(setting.passes - 1):
        estimator.rewind()
        estimator.run(u, y)
    return estimator, free_energy, (perf_counter() - start) / (setting.passes * samples)


def simulation_error(estimator: OnlineEstimator, test: Regime) -> FloatArray:
    """(T,) simulated minus measured outputs [V]; simulated from the inputs and the first `N_GIVEN_OUTPUTS` outputs."""
    return estimator.simulate(test.u, test.y[:N_GIVEN_OUTPUTS]) - test.y


def rmse(error: FloatArray) -> float:
    """Root mean square [V] of an error (T,) without its first `N_GIVEN_OUTPUTS` values."""
    return float(np.sqrt(np.mean(error[N_GIVEN_OUTPUTS:] ** 2)))


def samples_until_close(learning: Mapping[int, float]) -> int | None:
    """The number of samples from which on the error [V] of a learning curve is below `CLOSE_ERROR`, or None."""
    far = [samples for samples, error in learning.items() if not error < CLOSE_ERROR]
    close = [samples for samples in learning if not far or samples > far[-1]]
    return close[0] if close else None


def coverage(estimator: OnlineEstimator, training: Regime, test: Regime) -> float:
    """Fraction of the outputs within their 90 % intervals, while a copy of the estimator goes on from the training.

    An estimator with a lookahead processes an output once the next input is known: the last training output during the
    test, and the last test output never.
    """
    copy = deepcopy(estimator)
    copy.run(test.u, test.y)
    y = np.concatenate([training.y[len(training.y) - copy.lookahead :], test.y])[: len(copy.forecasts)]
    return coverage_of(copy.forecasts, y)


def coverage_of(forecasts: FloatArray, y: FloatArray) -> float:
    """Fraction of outputs (T,) within the 90 % intervals of forecasts (T, 2), means [V] and variances [V²], or NaN."""
    mean, variance = forecasts.T
    if np.isnan(variance).any():
        return float("nan")
    return float(np.mean(np.abs(y - mean) <= STDS_PER_90_PERCENT * np.sqrt(variance)))
