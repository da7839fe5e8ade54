"""A rig with a channel for each input, around its plant and in a run: each has its own unit, limit and column."""

import csv
from dataclasses import replace

import numpy as np
import pytest
from playing import assert_refused, random_actions
from reference.filters import Plant, moved
from reference.plants import TWO_MASSES

from agents.hardware.clock import JumpingClock
from agents.hardware.experiment_run import RunSettings, run_experiment
from agents.policies import make_policy
from duffing_env.tracks.rig_env import RigEnv
from estimator import Channel, OnlineEstimator, Rig
from estimator.priors import weak_prior

#: Two masses, of which a sensor sees the first.
MODEL = replace(TWO_MASSES, name="two_masses_seen_once", outputs={"y1": "x1"})
COEFFICIENTS = [0.3, 0.1, 0.1, 0.05]
LIMITS = np.array([4.0, 0.5])
RIG = Rig(
    0.01, input={"f1": Channel("N", limit=4.0), "f2": Channel("kN", limit=0.5, column="piston")},
    output=Channel("mm", range=5.0),
)  # fmt: skip
PRIOR = weak_prior(
    MODEL, [0.32, 0.09, 0.11, 0.048], np.diag([0.05, 0.02, 0.02, 0.01]) ** 2, 1e-3, 1e-3, state_std=[0.01] * 4,
    scales=RIG.scales,
)  # fmt: skip
OPTIONS = {"rig": RIG, "prior": PRIOR, "max_input": {"f1": 0.5, "f2": 0.8}, "noise_hypotheses": 1, "horizon": 40}


class Masses:
    """The two masses in the rig's units, stepped as the reference steps them; it records what it is given."""

    has_watchdog = False

    def __init__(self):
        self.clock = JumpingClock()
        self.reset()

    def reset(self):
        self.z, self.given, self.outputs = np.zeros(4), [], []
        self.applied, self.noise = np.zeros(2), np.random.default_rng(0)

    def step(self, u):
        self.given.append(u)
        self.z = moved(Plant.of(MODEL), self.z, COEFFICIENTS, (np.asarray(u) / LIMITS,))
        self.outputs.append(5.0 * (self.z[0] + 1e-3 * self.noise.standard_normal()))
        return self.outputs[-1]

    # As a plant of a run: each output is read before the next input.
    def read(self):
        return self.step(self.applied)

    def apply(self, u):
        self.applied = np.clip(u, -LIMITS, LIMITS)
        return self.applied

    def zero(self):
        self.applied = np.zeros(2)

    def arm(self, watchdog):
        self.armed = True

    def disarm(self):
        self.armed = False

    def play(self, u):
        raise AssertionError("no sample is played before the checks")


def test_a_plant_gets_each_input_in_its_unit_and_the_belief_is_that_of_the_record():
    paid = []

    def reward(before, after, u, y, truth):
        paid.append((u.copy(), y.copy()))
        return np.zeros(len(y))

    plant = Masses()
    env = RigEnv(plant=plant, render_mode="rgb_array", reward=reward, **OPTIONS)
    assert env.action_space.shape == (2,)
    env.reset(seed=0)
    actions = random_actions(40, inputs=2)[:, 0]
    for action in actions:
        observation, *_, info = env.step(action)
        assert env.plant_error is None
    given = np.array(plant.given)
    expected = LIMITS * [0.5, 0.8] * np.clip(actions, -1, 1).astype(float)
    np.testing.assert_allclose(given, expected, rtol=1e-15)
    np.testing.assert_allclose([u[0] for u, _ in paid], given, rtol=1e-12)
    np.testing.assert_allclose([y[0] for _, y in paid], plant.outputs, rtol=1e-12)
    estimator = OnlineEstimator(prior=env.experiment.prior_belief, rig=replace(RIG, delay=-1))
    estimator.run(given, plant.outputs)
    np.testing.assert_allclose(env.belief.mean, estimator.belief.mean, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(env.belief.cov, estimator.belief.cov, rtol=1e-8, atol=1e-14)
    assert info["information_gain"] > 0
    assert env.render().shape == (540, 960, 3)
    shown = env._renderer._history[-1][0]
    np.testing.assert_allclose(shown, given[-1], rtol=1e-12)
    assert env._renderer._input_units == {"f1": "N", "f2": "kN"}
    # The signals of a policy keep to each limit.
    action, _ = make_policy("prbs", env).predict(observation)
    assert action.shape == (2,)


#: A law for both forces: one holds, the other pulls back.
LAW = """import numpy as np
def law(observations):
    return np.column_stack([np.full(len(observations), 0.25), -np.sign(observations[:, -3])])
"""


def test_a_law_plays_a_run_whose_record_has_a_column_for_each_input(tmp_path, monkeypatch):
    plant = Masses()
    monkeypatch.chdir(tmp_path)
    (tmp_path / "law_of_two.py").write_text(LAW)
    settings = RunSettings(policy="law_of_two:law", samples=40, listen=8, stale=0, no_watchdog=True)
    result = run_experiment(RIG, plant, tmp_path / "run", settings, prior=PRIOR, clock=plant.clock)
    assert (result.outcome, result.message) == ("complete", "")
    with result.folder.joinpath("samples.csv").open() as file:
        rows = list(csv.DictReader(file))
    columns = ["f1", "piston"]
    u = np.array([[float(row[name] or "nan") for name in columns] for row in rows])
    commanded = np.array([[float(row[f"commanded_{name}"] or "nan") for name in ("f1", "f2")] for row in rows])
    assert len(rows) == 49
    assert not u[:8].any()
    np.testing.assert_array_equal(u[9:48, 0], 1.0)
    assert set(np.abs(u[9:48, 1])) == {0.5}
    np.testing.assert_array_equal(commanded[9:48], u[9:48])
    y = np.array([float(row["y"]) for row in rows])
    estimator = OnlineEstimator(
        prior=PRIOR, rig=replace(RIG, delay=-1), noise_hypotheses=(7, 7), expectations="sigma_points"
    )
    estimator.run(np.vstack([np.zeros((1, 2)), u[:-1]]), y)
    np.testing.assert_allclose(result.belief.mean, estimator.belief.mean, rtol=1e-6, atol=1e-9)


def test_channels_that_do_not_fit_are_refused():
    unlimited = replace(RIG, input={"f1": Channel("N", limit=4.0), "f2": Channel("kN")})
    turned = replace(RIG, input={"f2": Channel("kN", limit=4.0), "f1": Channel("N", limit=0.5)})
    same_scales = replace(PRIOR, scales=turned.scales)
    assert_refused(
        [
            (
                lambda: RigEnv(plant=Masses(), **OPTIONS | {"rig": unlimited}),
                "rig must have input.f2.limit to be played",
            ),
            (
                lambda: RigEnv(plant=Masses(), **OPTIONS | {"rig": turned, "prior": same_scales}),
                "rig.input must have a channel for each input of 'two_masses_seen_once', in its order ['f1', 'f2']",
            ),
            (lambda: RigEnv(plant=Masses(), rig=RIG), "rig must have guess to be played"),
            (lambda: RigEnv(rig=RIG), "rig must have guess to be played"),
        ]
    )
    with pytest.raises(ValueError, match="model must have one input for signals and blocks on a rig"):
        run_experiment(
            RIG, Masses(), "unused", RunSettings(policy="prbs", no_watchdog=True), prior=PRIOR, clock=JumpingClock()
        )
