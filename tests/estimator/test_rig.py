"""Rigs: their description, units and scales, and the prior of their guess."""

import json
import os
import re
import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from tables import table

from estimator import Channel, OnlineEstimator, Rig, load_estimator, save_estimator
from estimator.rigs.electronic_duffing import electronic_duffing
from estimator.rigs.rig import SHIPPED_RIGS
from estimator.rigs.rig_prior import rig_prior
from estimator.rigs.silverbox_constants import SILVERBOX_SAMPLING_STEP
from estimator.rigs.units import Scales

GUESS = {"m": (0.3, 0.5), "c": (0.1, 2.0), "a": (1e3, 5e3), "b": (-1e8, 1e8)}
BENCH = Rig(1e-3, input=Channel("N", limit=20.0), output=Channel("m", range=0.03), guess=GUESS)
#: Whose estimator other tests compile.
AHEAD = replace(BENCH, interpolation="look_ahead")
TOML = """
step = 1e-3
interpolation = "linear"
[input]
unit = "N"
limit = 20
[output]
unit = "m"
range = 0.03
noise = 5e-6
[guess]
m = [0.3, 0.5]
c = [0.1, 2]
a = [1e3, 5e3]
b = [-1e8, 1e8]
"""


def test_a_rig_is_the_same_from_a_file_a_dictionary_and_keywords(tmp_path):
    (tmp_path / "rig.toml").write_text(TOML)
    rig = Rig.from_file(tmp_path / "rig.toml")
    assert rig == Rig(
        1e-3, "linear", 0, Channel("N", limit=20), Channel("m", range=0.03, noise=5e-6), {**GUESS, "c": (0.1, 2)}
    )
    assert Rig.from_any(tomllib.loads(TOML)) == rig == Rig.from_any(json.loads(json.dumps(rig.to_dict())))


@table(
    "rig",
    [
        Rig(0.1),
        BENCH,
        Rig(np.float64(1 / 3), "linear", 2, {"unit": "N", "limit": np.float32(0.1), "noise": 1e-7, "offset": -0.2}),
        replace(BENCH, delay=-1, output=Channel("µm/s²", None, 3, "acceleration", 1e-300 * 1e280, 5.0, "Weg ü")),
        *map(Rig.shipped, SHIPPED_RIGS),
    ],
)
def test_a_saved_rig_is_the_same(rig, tmp_path):
    rig.save(tmp_path / "new" / "rig.toml")
    assert Rig.from_file(tmp_path / "new" / "rig.toml") == rig
    with pytest.raises(ValueError, match="path must be the name of a file"):
        rig.save("a\0b")


@table(
    ("change", "message"),
    [
        ({"stepp": 1.0}, "rig must have keys of"),
        ({"stepp": 1.0}, "did you mean 'step'?"),
        ({"step": -1.0}, "step must be a number from 1e-30 to 1e+30, but is -1.0; give the seconds"),
        ({"step": True}, "step must be a number from 1e-30 to 1e+30, but is True"),
        ({"step": 10**400}, "step must be a number from 1e-30 to 1e+30, but is 1000"),
        ({"interpolation": []}, "interpolation must be one of"),
        ({"interpolation": "cubic"}, "interpolation must be one of"),
        ({"delay": -1.5}, "delay (for zero_order) must be"),
        ({"delay": 0.5, "interpolation": "look_ahead"}, "interpolation (for a fractional delay) must be one of"),
        ({"input": {"unit": "N", "range": 3.0}}, "input must have no range, but has 3.0; use limit"),
        ({"output": {"unit": "m", "limit": 3.0}}, "output must have no limit, but has 3.0; use range"),
        ({"input": {"unit": "N", "kind": "velocity"}}, "input must have no kind"),
        ({"output": {"kind": "jerk"}}, "kind must be one of ['displacement', 'velocity', 'acceleration']"),
        ({"output": {"unit": "mm", "kind": "velocity"}}, "output.kind must be 'displacement' with the unit mm, but is"),
        ({"output": {"noise": 0}}, "noise must be a number from 1e-30 to 1e+30, but is 0; leave it out"),
        ({"output": {"unit": ""}}, "unit must be a short text"),
        ({"output": 3}, "output must be a Channel, but is 3"),
        ({"guess": {"m": [1, 2]}}, "guess must have intervals of ['m', 'c', 'a', 'b'], but is of ['m']"),
        ({"guess": {**GUESS, "a": [2, 1]}}, "guess of a must be two numbers, low < high, but is [2, 1]"),
        ({"guess": {**GUESS, "m": [-1, 1]}}, "from 1e-30 to 1e+30, but is -1; a mass is above 0"),
    ],
)
def test_errors_name_the_key_and_the_remedy(change, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        Rig.from_dict({"step": 1e-3, **change})


def test_a_broken_file_is_named(tmp_path):
    (tmp_path / "rig.toml").write_text("step = ")
    with pytest.raises(ValueError, match=r"rig\.toml must be a rig file, but is not: Invalid"):
        Rig.from_file(tmp_path / "rig.toml")
    (tmp_path / "rig.toml").write_text("step = 0,01")
    with pytest.raises(ValueError, match=r"a number has a point: 0\.5, not 0,5"):
        Rig.from_file(tmp_path / "rig.toml")
    for nested in ("[" * 100_000, "x = " + "[" * 100_000, "step = 1e999", "step = " + "9" * 400):
        (tmp_path / "rig.toml").write_text(nested)
        with pytest.raises(ValueError, match=r"rig\.toml must be a rig file, but is not: "):
            Rig.from_file(tmp_path / "rig.toml")
    with pytest.raises(FileNotFoundError, match="there is no"):
        Rig.from_file(tmp_path / "none.toml")
    os.mkfifo(tmp_path / "fifo")  # reading it would wait for a writer
    for place in (tmp_path / "fifo", tmp_path, "/dev/zero", "a" * 300, "a\0b"):
        with pytest.raises(ValueError, match=r"rig must be a file, a short TOML, or one of .* name"):
            Rig.from_file(place)
    with pytest.raises(ValueError, match="rig must have a step"):
        Rig.from_dict({})


def test_rigs_that_ship():
    assert set(SHIPPED_RIGS) == {
        "silverbox",
        "beam",
        "electronic-duffing",
        "electronic-duffing-two-wells",
        "electronic-duffing-velocity",
    }
    assert (
        Rig.silverbox()
        == Rig.shipped("silverbox")
        == Rig(SILVERBOX_SAMPLING_STEP, "spline", 0, Channel("V"), Channel("V"))
    )
    assert Rig.silverbox("zero_order", 1) == Rig(SILVERBOX_SAMPLING_STEP, "zero_order", 1, Channel("V"), Channel("V"))
    with pytest.raises(ValueError, match=r"name must be one of .*, but is 'bea'; did you mean 'beam'\?"):
        Rig.shipped("bea")


def test_a_file_that_is_named_like_a_rig_that_ships_is_found(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "beam").write_text("step = 3")
    assert Rig.from_any("beam") == Rig.shipped("beam")
    assert Rig.from_any("./beam") == Rig(3)


@table(
    ("name", "settings"),
    [
        ("electronic-duffing", {}),
        ("electronic-duffing-two-wells", {"wells": 2}),
        ("electronic-duffing-velocity", {"kind": "velocity"}),
    ],
)
def test_the_board_s_files_are_those_of_its_potentiometers(name, settings):
    shipped, made = Rig.shipped(name), electronic_duffing(**settings)
    assert replace(shipped, guess=None) == replace(made, guess=None)
    for parameter in "mcab":
        assert shipped.guess[parameter] == pytest.approx(made.guess[parameter], rel=1e-9)
    # What its documentation identifies lies inside.
    identified = (1.0461e-4, 1.4231e-4, 1.8099 if made.guess["a"][0] > 0 else -1.8099, 1.0077)
    for parameter, value in zip("mcab", identified, strict=True):
        low, high = made.guess[parameter]
        assert low < value < high


@table(
    ("change", "message"),
    [
        ({"p1": 0.0}, "to 1, but is 0.0; give the potentiometer's division ratio"),
        ({"p3": 2}, "to 1, but is 2; give the potentiometer's division ratio"),
        ({"p2": None}, "p2 must be a number from "),
        ({"wells": 3}, "wells must be a whole number from 1 to 2, but is 3"),
        ({"wells": True}, "wells must be a whole number from 1 to 2, but is True"),
        ({"kind": "acceleration"}, "kind must be one of ['displacement', 'velocity'], but is 'acceleration'"),
    ],
)
def test_potentiometers_are_checked(change, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        electronic_duffing(**change)


@table(
    ("input_unit", "output_unit", "order", "units"),
    [
        ("N", "m", 0, ("kg", "N s/m", "N/m", "N/m³")),
        ("N", "m/s", 1, ("kg", "N s/m", "N/m", "N/m³")),
        ("N", "m/s^2", 2, ("kg", "N s/m", "N/m", "N/m³")),
        ("V", "V", 0, ("s²", "s", "1", "V⁻²")),
        ("V", "mm", 0, ("V s²/mm", "V s/mm", "V/mm", "V/mm³")),
    ],
)
def test_units_of_parameters(input_unit, output_unit, order, units):
    scales = Scales(1.0, 1.0, 1.0, order, input_unit, output_unit)
    assert tuple(map(scales.unit, [(1, -1, 2), (1, -1, 1), (1, -1, 0), (1, -3, 0)])) == units


def test_a_guess_is_the_prior_s_interval():
    parameters = rig_prior(BENCH).parameters()
    for name in "cab":
        low, high = GUESS[name]
        mean, std, _ = parameters[name]
        # To first order the prior's moments give the guess's moments, as far as m is sharp: it is known to 15 %.
        assert mean == pytest.approx((low + high) / 2, abs=0.1 * (high - low))
        assert std == pytest.approx((high - low) / 2 / 1.645, rel=0.25)
    assert parameters["m"][0] == pytest.approx(0.387, abs=0.01)


def test_numbers_do_not_depend_on_the_units():
    """The same bench in newtons and metres, and in millinewtons and micrometres."""
    small = Rig(
        1e-3,
        "look_ahead",
        input=Channel("mN", limit=20e3),
        output=Channel("um", range=0.03e6),
        guess={name: tuple(v * (1e-3 if name != "b" else 1e-15) for v in GUESS[name]) for name in GUESS},
    )
    rng = np.random.default_rng(0)
    u, y = rng.choice([-6.0, 6.0], 300), 0.01 * rng.standard_normal(300).cumsum() / 10
    one, other = OnlineEstimator(rig=AHEAD), OnlineEstimator(rig=small)
    assert one.settings.noise_hypotheses == (7, 7)
    one.run(u, y)
    other.run(1e3 * u, 1e6 * y)
    for name, (mean, std, _) in one.belief.parameters().items():
        factor = {"u0": 1e3, "y0": 1e6, "b": 1e-15}.get(name, 1e-3)
        assert other.belief.parameters()[name][:2] == pytest.approx((mean * factor, std * factor), rel=1e-6)
    np.testing.assert_allclose(other.forecasts[:, 0], 1e6 * one.forecasts[:, 0], rtol=1e-6, atol=1e-6)


def test_an_estimator_of_a_rig_is_saved_whole(tmp_path):
    estimator = OnlineEstimator(rig=AHEAD)
    rng = np.random.default_rng(1)
    u, y = rng.choice([-6.0, 6.0], 40), 1e-3 * rng.standard_normal(40)
    estimator.run(u[:20], y[:20])
    save_estimator(estimator, tmp_path / "e.npz")
    other = load_estimator(tmp_path / "e.npz")
    assert (other.rig, other.scales) == (AHEAD, AHEAD.scales)
    for one in (estimator, other):
        one.run(u[20:], y[20:])
    assert other.belief == estimator.belief


def test_the_instrument_comes_from_the_file_that_the_rig_comes_from(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("beam").write_text("step = 0.5\n[instrument]\nresource = 'ASRL1'\n", encoding="utf-8-sig")
    assert Rig.read_with_instrument("beam") == (Rig.shipped("beam"), {})
    assert Rig.read_with_instrument("./beam") == (Rig(0.5), {"resource": "ASRL1"})
    Path("beam").write_text("step = 0.5\ninstrument = 3\n")
    with pytest.raises(ValueError, match="beam must be a rig file, but is not: instrument must be a table, but is 3"):
        Rig.read_with_instrument("./beam")


@pytest.mark.parametrize(
    ("where", "channel", "message"),
    [
        ("input", {"limit": -1}, "input.limit must be a number from 1e-30 to 1e+30, but is -1; leave it out"),
        ("output", {"range": 1e300}, "output.range must be a number from 1e-30 to 1e+30, but is 1e+300"),
        ("output", {"limit": -1}, "output must have no limit, but has -1; use range"),
        ("input", {"range": "wide"}, "input must have no range, but has 'wide'; use limit"),
        ("input", {"noise": 0.0}, "input.noise must be a number"),
        ("output", {"noise": 0.0}, "output.noise must be a number"),
        ("output", {"offset": "x"}, "output.offset must be a number"),
        ("input", {"unit": ""}, "input.unit must be a short text"),
        ("output", {"column": 3}, "output.column must be a name"),
        ("output", {"kind": "speed"}, "output.kind must be one of"),
        ("input", {"limits": 3}, "input must have keys of"),
    ],
)
def test_an_error_names_the_channel(where, channel, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        Rig.from_dict({"step": 1e-3, where: channel})


def test_a_channel_alone_says_whose_limit_or_range_is_wrong():
    with pytest.raises(ValueError, match="limit of an input must be a number"):
        Channel(limit=-1)
    with pytest.raises(ValueError, match="range of an output must be a number"):
        Channel(range=np.inf)
