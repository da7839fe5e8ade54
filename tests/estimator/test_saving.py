"""Saved estimators continue bit by bit, and all other files are refused."""

import io
import json
import os
import re

import numpy as np
import pytest
from estimators import KINDS, assert_same, record
from tables import table

from estimator import OnlineEstimator, load_estimator, save_estimator

FEW = ("paper", "mean field", "own terms, drift", "ode, look-ahead", "ensemble")


@table("kind", KINDS)
def test_a_saved_estimator_continues_bit_by_bit(kind, tmp_path):
    u, y = record()
    original = KINDS[kind]()
    original.run(u[:200], y[:200])
    save_estimator(original, tmp_path / "estimator.npz")
    resumed = load_estimator(tmp_path / "estimator.npz")
    assert (resumed.model, resumed.rig, resumed.settings) == (original.model, original.rig, original.settings)
    np.testing.assert_array_equal(resumed.run(u[200:], y[200:]), original.run(u[200:], y[200:]))
    assert_same(original, resumed)
    original.rewind()
    resumed.rewind()
    np.testing.assert_array_equal(resumed.run(u, y), original.run(u, y))


# --- Foreign files ------------------------------------------------------------------------------------------------


@pytest.fixture
def written(tmp_path):
    """The path of a file of an estimator with a stored sample, and its arrays."""
    path = tmp_path / "estimator.npz"
    estimator = KINDS["ode, look-ahead"]()
    estimator.run(*record(12))
    save_estimator(estimator, path)
    with np.load(path) as archive:
        return path, {name: archive[name] for name in archive.files}


def described(arrays, **changes):
    """The arrays with another description."""
    described = {**json.loads(arrays["description"].tobytes()), **changes}
    return {**arrays, "description": np.frombuffer(json.dumps(described).encode(), dtype=np.uint8)}


REFUSED = {
    "no description": lambda a: {name: array for name, array in a.items() if name != "description"},
    "another version": lambda a: described(a, format=1),
    "an unknown model": lambda a: described(a, model={"name": "x"}),
    "a model that runs code": lambda a: described(
        a, model={**json.loads(a["description"].tobytes())["model"], "rates": ["v", "().__class__"]}
    ),
    "an impossible rig": lambda a: described(a, rig={"step": -1.0, "interpolation": "linear", "delay": 0}),
    "impossible settings": lambda a: described(a, settings={"iterations": 2**31}),
    "an array too many": lambda a: {**a, "more": np.zeros(3)},
    "an array too few": lambda a: {name: array for name, array in a.items() if name != "walk"},
    "too many waiting": lambda a: {**a, "outputs": np.ones((50, 1))},
    "too many inputs": lambda a: {**a, "inputs": np.ones(50)},
    "numbers of another kind": lambda a: {**a, "records": a["records"].astype(np.float32)},
    "objects": lambda a: {**a, "records": np.array([{"a": 1}], dtype=object)},
    "inputs that are not finite": lambda a: {**a, "inputs": a["inputs"] * np.nan},
    "a belief that is not finite": lambda a: {**a, "records": a["records"] * np.nan},
    "inputs that are absurd": lambda a: {**a, "inputs": np.full_like(a["inputs"], 1e300)},
    "a waiting output that is absurd": lambda a: {**a, "outputs": np.full_like(a["outputs"], -1e300)},
    "a walk that is absurd": lambda a: {**a, "walk": a["walk"] + 1e300},
    "a negative covariance": lambda a: {**a, "records": a["records"] * np.where(np.arange(len(a["first"])) > 8, -1, 1)},
    "a prior with a negative covariance": lambda a: {**a, "first": a["first"] * np.where(a["first"] > 0, -1, 1)},
    "a negative walk": lambda a: {**a, "walk": a["walk"] - 1.0},
    "weights that do not sum to 1": lambda a: {**a, "weights": a["weights"] * 2},
    "half begun": lambda a: {**a, "begun": a["begun"] * 0.5},
}


@table("what", REFUSED)
def test_a_file_with_wrong_content_is_refused(what, written):
    path, arrays = written
    np.savez(path, **REFUSED[what](arrays))
    with pytest.raises(
        ValueError, match=f"path must be a whole file of .* or a run, but {re.escape(str(path))} is not"
    ):
        load_estimator(path)


@pytest.mark.parametrize("array", ["records", "first"])
@pytest.mark.parametrize("place", [2, 20, -1], ids=["mean", "covariance", "rate"])
@pytest.mark.parametrize("value", [1e300, -1e200, 1e61])
def test_an_absurd_number_of_a_belief_is_refused_by_its_name(array, place, value, written):
    """It is finite, and would overflow at the first sample."""
    path, arrays = written
    arrays[array][..., place] = value
    np.savez(path, **arrays)
    with pytest.raises(ValueError, match=rf"{re.escape(str(path))} is not .*, but \w+ is {re.escape(f'{value:g}')}; "):
        load_estimator(path)


def test_a_damaged_file_is_refused(written):
    path, _ = written
    whole = path.read_bytes()
    rng = np.random.default_rng(0)
    pieces = [whole[:n] for n in (0, 1, 100, len(whole) // 2, len(whole) - 1)]
    changed = [bytearray(whole) for _ in range(60)]
    for piece in changed:
        for place in rng.integers(len(whole), size=20):
            piece[place] ^= 1 << rng.integers(8)
    for content in (*pieces, *changed, b"not an archive", b"PK\x03\x04"):
        path.write_bytes(content)
        with pytest.raises(ValueError, match="path must be a whole file of save_estimator"):
            load_estimator(path)


def test_what_is_no_file_is_refused(tmp_path):
    os.mkfifo(tmp_path / "fifo")  # reading it would wait for a writer
    for place in (tmp_path, tmp_path / "fifo"):
        with pytest.raises(ValueError, match="is not one; name the file itself"):
            load_estimator(place)
    with pytest.raises(FileNotFoundError, match="there is no"):
        load_estimator(tmp_path / "missing.npz")
    huge = io.BytesIO()
    np.savez_compressed(huge, description=np.zeros(10**8, dtype=np.uint8))
    (tmp_path / "bomb.npz").write_bytes(huge.getvalue())
    with pytest.raises(ValueError, match="it unpacks to 100000"):
        load_estimator(tmp_path / "bomb.npz")


# --- Arrays --------------------------------------------------------------------------------------------------------


@table("kind", FEW)
def test_restore_is_all_or_nothing(kind):
    estimator, other, untouched = (KINDS[kind]() for _ in range(3))
    other.run(*record())
    arrays = other.arrays()
    for name, array in arrays.items():
        others = {key: value for key, value in arrays.items() if key != name}
        for wrong in (others, {**others, name: array[None]}, {**others, name: array.astype(np.float32)}):
            with pytest.raises(ValueError, match=r"use arrays\(\) of an estimator"):
                estimator.restore(wrong)
            assert_same(estimator, untouched)
    with pytest.raises(ValueError, match="records must be numbers, but is"):
        estimator.restore({**arrays, "records": [[1.0, 2.0], [3.0]]})
    assert_same(estimator, untouched)
    estimator.restore(arrays)
    for array in arrays.values():
        array[...] = 0.0
    np.testing.assert_array_equal(estimator.belief.record, other.belief.record)


@table("place", [3, ".", "a" * 300, "\0"])
def test_what_cannot_be_written_is_refused(place, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ValueError, match="path must be the name of a file"):
        save_estimator(KINDS["paper"](), place)
    with pytest.raises(ValueError, match="estimator must be an OnlineEstimator, but is 3"):
        save_estimator(3, "estimator.npz")
    assert not list(tmp_path.iterdir())


def test_members_with_absurd_numbers_are_refused():
    estimator = KINDS["ensemble"]()
    estimator.run(*record(12))
    arrays = estimator.arrays()
    arrays["records"] *= 1e300
    with pytest.raises(ValueError, match=r"records must be within ±1e\+\d0, but \w+ is "):
        estimator.restore(arrays)


def test_an_ensemble_without_some_members_comes_back(tmp_path):
    estimator = KINDS["ensemble"]()
    estimator.run(*record())
    arrays = estimator.arrays()
    arrays["records"][0], arrays["weights"][0] = np.nan, 0.0
    arrays["weights"] /= arrays["weights"].sum()
    estimator.restore(arrays)
    save_estimator(estimator, tmp_path / "estimator.npz")
    resumed = load_estimator(tmp_path / "estimator.npz")
    for name, array in estimator.arrays().items():
        np.testing.assert_array_equal(resumed.arrays()[name], array, err_msg=name)
    assert resumed.belief == estimator.belief


def test_nothing_is_half_written(tmp_path, monkeypatch):
    path = tmp_path / "estimator.npz"
    save_estimator(OnlineEstimator(), path)
    before = path.read_bytes()

    def fail(*_):
        raise OSError("disk full")

    monkeypatch.setattr("estimator.support.file_io.os.replace", fail)
    with pytest.raises(OSError, match="disk full"):
        save_estimator(KINDS["ode"](), path)
    assert path.read_bytes() == before
    assert [entry.name for entry in tmp_path.iterdir()] == ["estimator.npz"]
