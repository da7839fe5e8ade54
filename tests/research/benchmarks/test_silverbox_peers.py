"""Peers in the Silverbox protocol: that they get our models and priors, and are judged as ours. None is installed."""

import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from benchmarks import peer_process, silverbox_comparison, silverbox_peer_filters
from benchmarks.peer_process import NotAvailable, Peers
from benchmarks.silverbox_comparison import MODELS, OFFLINE, PEERS, Contender
from benchmarks.timed_rounds import Result
from duffing_env.plants.silverbox_record import Regime
from estimator import OnlineEstimator
from estimator.belief import Belief
from research.studies.silverbox_protocol import (
    SETTINGS,
    TESTS,
    TRAINING_LENGTHS,
    TRAINING_SAMPLES,
    ProtocolOutcome,
    Sections,
    evaluate,
)


def time(*values: float) -> Result:
    return Result("row", silverbox_comparison.UNIT, values)


# --- The models that they get --------------------------------------------------------------------------------------


def test_their_ode_moves_as_ours() -> None:
    rng = np.random.default_rng(0)
    prior = silverbox_comparison.prior_of("ode")
    parameters = np.array([0.49, 0.069, 0.5, 1.96, -1e-3, 3e-3, 0.01])
    z, v, last, now = 0.1 * rng.standard_normal(4)
    mean, cov = np.empty(9), np.zeros((9, 9))
    mean[silverbox_comparison._MOTION] = [z, v, *parameters]
    cov[:2, :2] = 1e-30 * np.eye(2)
    known = Belief.of(prior.model, mean, cov, (1.0, 1e-30), (1.0, 1.0))
    ours = OnlineEstimator(prior.model, known, SETTINGS["ODE linear"].rig)
    # The first input is that before the sample whose motion is compared.
    ours.run([last], [np.nan], missing=True)
    begin = ours.belief.state_mean
    ours.run([now], [np.nan], missing=True)
    moved = silverbox_peer_filters.flow(prior.model.substeps)([*begin, *parameters], (now, last, 0.0))
    np.testing.assert_allclose(moved, ours.belief.state_mean, rtol=0, atol=1e-15)


@pytest.fixture(scope="module")
def sections() -> Sections:
    """A simulated oscillator, 3,000 samples of training."""
    rng = np.random.default_rng(1)
    u = 0.03 * np.convolve(rng.standard_normal(5003), np.full(4, 0.5), mode="valid")
    y = SETTINGS["ODE linear"].estimator().simulate(u, [0.0, 0.0]) + 3e-4 * rng.standard_normal(5000)
    regimes = {name: Regime(name, u[3000:], y[3000:]) for name in TESTS}
    return Sections(Regime("training", u[:3000], y[:3000]), **regimes)


@dataclass(frozen=True)
class Learned:
    gamma_mean: float = 1 / 5e-6**2
    xi_mean: float = 1 / 3e-4**2


@pytest.fixture(scope="module")
def outcomes() -> dict[str, ProtocolOutcome]:
    errors = dict.fromkeys(TESTS, 4e-4)
    beliefs = {TRAINING_SAMPLES: Learned()}
    outcome = ProtocolOutcome(errors, 1e-4, 0.9, 1e-6, 0.0, {50: 4e-4}, beliefs, np.zeros(3))  # type: ignore[arg-type]
    return {ours: outcome for ours in MODELS.values()}


@pytest.fixture(scope="module")
def given(sections: Sections, outcomes: dict[str, ProtocolOutcome]) -> dict[str, np.ndarray]:
    return {name: np.asarray(value) for name, value in silverbox_comparison.given(sections, outcomes).items()}


def extended_kalman_filter(model: silverbox_peer_filters.Model, u: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Textbook, with Jacobians by central differences: what dynamax computes, but that it moves first, as ours does."""
    mean, cov = model.mean.copy(), model.cov.copy()
    steps = 1e-6 * np.eye(len(mean))

    def transition(state: np.ndarray, taps: np.ndarray) -> np.ndarray:
        return np.concatenate([model.move(state, taps), state[2:]])

    for taps, output in zip(silverbox_peer_filters.taps_of(u), y, strict=True):
        slopes = [(transition(mean + step, taps) - transition(mean - step, taps)) / 2e-6 for step in steps]
        mean, cov = transition(mean, taps), np.array(slopes).T @ cov @ np.array(slopes) + model.process_cov
        readout = np.array([model.read(row, taps) for row in np.eye(len(mean))])
        gain = cov @ readout / (readout @ cov @ readout + model.measurement_cov[0, 0])
        mean = mean + gain * (output - model.read(mean, taps))
        cov = cov - np.outer(gain, readout @ cov)
    return mean


# Theirs takes a held force to move (z, z') by (1/2, 1), ours counts spring and damper in: a tenth of it. Without
# process noise, and for a regression, they are the same but for the rounding of the differences: 1e-16 / 1e-6 a sample.
@pytest.mark.parametrize(
    ("name", "process_noise", "tolerance"), [("ode", 0.0, 1e-5), ("ode", 5e-6, 0.1), ("three-tap", 5e-6, 1e-5)]
)
def test_with_noises_that_are_known_theirs_is_our_filter(
    name: str, process_noise: float, tolerance: float, sections: Sections, given: dict
) -> None:
    u, y = sections.training.u[:300], sections.training.y[:300]
    with_noise = {**given, f"{name}_process_variance": process_noise**2}
    theirs = extended_kalman_filter(silverbox_peer_filters.model(with_noise, name), u, y)
    prior = silverbox_comparison.prior_of(name)
    certain = 1e15
    noises = (certain, certain * max(process_noise, 1e-15) ** 2), (certain, certain * 3e-4**2)
    setting = SETTINGS[MODELS[name]]
    ours = OnlineEstimator(setting.model, Belief.of(prior.model, prior.mean, prior.cov, *noises), setting.rig)
    ours.run(u, y)
    mean, std = ours.belief.mean, np.sqrt(np.diag(ours.belief.cov))
    places = silverbox_comparison._MOTION if name == "ode" else list(range(len(mean)))
    np.testing.assert_allclose((theirs - mean[places]) / std[places], 0.0, atol=tolerance)


# --- How they are judged -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", MODELS)
def test_a_peer_that_answers_our_means_gets_our_errors(
    name: str, sections: Sections, monkeypatch: pytest.MonkeyPatch
) -> None:
    ours = MODELS[name]
    lengths = (500, 3000)
    monkeypatch.setattr("research.studies.silverbox_protocol.TRAINING_LENGTHS", lengths)
    monkeypatch.setattr("research.studies.silverbox_protocol.TRAINING_SAMPLES", 3000)
    monkeypatch.setattr("research.studies.silverbox_protocol.N_TIMINGS", 1)
    monkeypatch.setattr(silverbox_comparison, "TRAINING_LENGTHS", lengths)
    monkeypatch.setattr(silverbox_comparison, "TRAINING_SAMPLES", 3000)
    outcome = evaluate(SETTINGS[ours], sections)
    means = []
    for belief in outcome.beliefs.values():
        if name == "ode":
            means.append(belief.mean[silverbox_comparison._MOTION])
        else:
            means.append(np.concatenate([[9.0, 9.0], belief.coefficients_mean]))
    forecasts = [[y, 1e-8] for y in sections.multisine.y]
    forecasts[:500] = [[y + 1.0, 1e-8] for y in sections.multisine.y[:500]]
    answer = {"means": [mean.tolist() for mean in means], "forecasts": forecasts}
    contender = silverbox_comparison.judge(name, answer, time(1.0), sections, {ours: outcome})
    assert contender.coverage == 0.75
    tolerance = 1e-6
    for test in TESTS:
        assert contender.errors[test] == pytest.approx(outcome.rmse[test], rel=tolerance)
    for samples in lengths:  # a peer's runs begin with the noises of the end
        assert contender.learning[samples] == pytest.approx(outcome.learning[samples], rel=max(tolerance, 1e-3))


def test_means_that_are_not_finite_have_no_errors(sections: Sections, outcomes: dict[str, ProtocolOutcome]) -> None:
    answer = {"means": [[np.nan] * 9] * len(TRAINING_LENGTHS), "forecasts": None}
    contender = silverbox_comparison.judge("three-tap", answer, time(1.0), sections, outcomes)
    assert all(np.isnan(error) for error in [*contender.errors.values(), contender.coverage])
    assert contender.to_dict()["samples_until_1_mV"] is None


def test_least_squares_rows_get_the_same_regressors(given: dict, monkeypatch: pytest.MonkeyPatch) -> None:
    class LeastSquares:
        def __init__(self, n: int, **settings: object) -> None:
            self.w = np.zeros(n)

        def run(self, d: np.ndarray, x: np.ndarray) -> None:
            self.w = np.linalg.lstsq(x, d, rcond=None)[0]

    monkeypatch.setitem(sys.modules, "padasip", type(sys)("padasip"))
    filters = type(sys)("padasip.filters")
    filters.FilterRLS = LeastSquares  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "padasip.filters", filters)
    noiseless = dict(given)
    truth = np.array([1.45, -1.5, -0.93, 0.1, 0.2, 0.1, 1e-3])
    noiseless["y"] = SETTINGS["NLARX three-tap"].estimator().simulate(given["u"], [0.0, 0.0])
    u, y = given["u"], np.zeros(400)
    for t in range(2, 400):
        y[t] = truth @ [y[t - 1], y[t - 1] ** 3, y[t - 2], u[t], u[t - 1], u[t - 2], 1.0]
    noiseless |= {"u": u[:400], "y": y}
    means, forecasts = silverbox_peer_filters.padasip_rls(noiseless, "three-tap")(400, (400,))
    np.testing.assert_allclose(means[0][2:], truth, atol=1e-8)
    assert forecasts is None


def test_speed_counts_at_equal_or_better_errors() -> None:
    ours = Contender(time(1.0, 2.0, 3.0), dict.fromkeys(TESTS, 4.004e-4))
    for error, no_worse in ((4.0e-4, True), (3.99e-4, False), (5e-4, True)):
        theirs = Contender(time(20.0, 9.0, 30.0), dict.fromkeys(TESTS, error))
        contenders = {"ODE linear": ours, "dynamax EKF, ODE linear": theirs}
        assert silverbox_comparison.faster(contenders, "dynamax EKF, ODE linear") == (10.0, no_worse)


# --- Peers that are missing ----------------------------------------------------------------------------------------


def test_missing_peers_are_rows_that_say_so(
    sections: Sections,
    outcomes: dict[str, ProtocolOutcome],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture,
) -> None:
    monkeypatch.setattr(peer_process, "ensure_environment", lambda: Path(sys.executable))
    monkeypatch.setattr(silverbox_comparison, "REPETITIONS", 1)
    monkeypatch.setattr("benchmarks.timed_rounds.LONG_ENOUGH", 0.0)
    found = silverbox_comparison.compare(sections, outcomes)
    printed = " ".join(capsys.readouterr().out.split())
    for title in (*PEERS, OFFLINE):
        package = title.split()[0].replace("dynamax", "jax")  # its row imports jax first
        reason = f"ModuleNotFoundError: No module named '{package}"
        assert found["rows"][title]["not_available"].startswith(reason)
        assert f"{title}: not available: {reason}" in printed
    for ours in MODELS.values():
        assert found["rows"][ours]["rmse"] == dict.fromkeys(TESTS, 4e-4)
        assert found["rows"][ours]["time"]["median"] > 0
    assert set(found["times_as_fast"].values()) == {None}
    assert "not available: dynamax EKF, ODE linear" in printed


def test_without_peers_the_table_says_so(
    sections: Sections, outcomes: dict[str, ProtocolOutcome], tmp_path: Path
) -> None:
    with Peers(tmp_path / "given.npz", wanted=False) as peers:
        assert silverbox_comparison._offline(peers, sections).reason == "--no-peers"
        with pytest.raises(NotAvailable, match="--no-peers"):
            peers.ask("silverbox dynamax ode time", 1)
