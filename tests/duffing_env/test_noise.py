"""The kernel's random numbers are NumPy's SFC64, bit for bit, and its normal numbers are normal."""

import numpy as np
import pytest
from rounding import U64
from scipy import stats

from duffing_env.batch import Batch, spawn_seeds
from duffing_env.experiment_config import SimulatedExperiment
from duffing_env.kernel import RESET_NEXT_STEP
from duffing_env.storage.random_streams import (
    SEED_BRANCHES,
    box_muller,
    float_to_word,
    new_stream_words,
    sfc64_next,
    to_open_uniform,
    word_to_float,
)
from estimator.compilation.simd import LANES


def numpy_stream(words):
    bits = np.random.SFC64(0)
    state = bits.state
    state["state"]["state"] = np.array(words, dtype=np.uint64)
    bits.state = state
    return bits


def words_of(batch, row):
    """The four words of a row's stream."""
    first = batch._row_of["SFC64_a"]
    return batch._blocks[row // LANES, first : first + 4, row % LANES].copy().view(np.uint64)


def make_batch(size, seed=0):
    batch = Batch(SimulatedExperiment(), size, RESET_NEXT_STEP)
    for row, child in enumerate(spawn_seeds(seed, size)):
        batch.seed(row, np.random.default_rng(child))
    batch.reset(np.ones(size, dtype=np.bool_))
    return batch


@pytest.fixture(scope="module")
def normals():
    """(2, steps, rows) process and measurement noise of a batch at rest."""
    batch = make_batch(500)
    noise = np.empty((2, 250, 500))
    for t in range(noise.shape[1]):
        batch.step(np.zeros((500, 1)))
        noise[:, t] = batch.row_values("NOISE_w"), batch.row_values("NOISE_v")
    assert not batch.row_values("NEEDS_RESET").any()
    return noise


@pytest.mark.parametrize("seed", [0, 1, 2**63])
def test_draws_equal_numpy(seed):
    words = new_stream_words(np.random.default_rng(seed)).view(np.uint64)
    expected = numpy_stream(words)
    for _ in range(1000):
        value, *words = sfc64_next(*(np.uint64(word) for word in words))
        assert value == expected.random_raw()
    assert list(words) == expected.state["state"]["state"].tolist()


def test_a_stream_is_seeded_with_128_bits_of_the_generator():
    entropy = np.random.default_rng(5).integers(0, 2**32, size=4, dtype=np.uint32)
    expected = np.random.SFC64(np.random.SeedSequence(entropy.tolist())).state["state"]["state"]
    np.testing.assert_array_equal(new_stream_words(np.random.default_rng(5)).view(np.uint64), expected)


def test_any_word_survives_as_a_float():
    signalling_nan, quiet_nan, denormal = 0x7FF0000000000001, 0xFFF8000000000000, 1
    for word in (0, denormal, signalling_nan, quiet_nan, 2**64 - 1):
        assert float_to_word(word_to_float(np.uint64(word))) == word


def test_streams_in_blocks_equal_numpy():
    # 40,000 words pass through float64 rows here, some forty of which are NaN to a float64.
    batch = make_batch(70, seed=3)
    expected = [
        numpy_stream(new_stream_words(np.random.default_rng(child)).view(np.uint64)) for child in spawn_seeds(3, 70)
    ]
    for _ in range(200):
        batch.step(np.zeros((70, 1)))
    for row, bits in enumerate(expected):
        bits.random_raw(4 + 2 * 200)  # an oscillator, then two draws a step
        np.testing.assert_array_equal(words_of(batch, row), bits.state["state"]["state"])


def test_uniform_numbers_are_inside_the_unit_interval():
    assert to_open_uniform(np.uint64(0)) == 2.0**-53
    assert to_open_uniform(np.uint64(2**64 - 1)) == 1.0 - 2.0**-53
    assert to_open_uniform(np.uint64(1 << 63)) == 0.5 + 2.0**-53


def test_normal_pair_is_box_and_muller():
    rng = np.random.default_rng(0)
    quarters = np.array([0.0, 0.125, 0.25, 0.375, 0.5, 0.625, 0.75, 0.875, 1.0])
    turns = np.concatenate([rng.uniform(size=2000), np.clip(quarters[:, None] + [-1e-9, 1e-9], 2.0**-53, 1).ravel()])
    radii = np.concatenate([[2.0**-53, 1.0 - 2.0**-53], 10 ** -rng.uniform(0, 15, len(turns) - 2)])
    pairs = np.array([box_muller(first, second) for first, second in zip(radii, turns, strict=True)])
    length = np.sqrt(-2.0 * np.log(radii))
    expected = length[:, None] * np.stack([np.cos(2 * np.pi * turns), np.sin(2 * np.pi * turns)], axis=1)
    # The cosine's Taylor polynomial leaves out less than 4e-13; ten roundings of angles on a side are little beside it.
    assert (np.abs(pairs - expected) <= (4e-13 + 2 * np.pi * 20 * U64) * length[:, None]).all()


def test_noise_is_standard_normal(normals):
    for values in normals:
        values = values.ravel()
        n = values.size
        assert stats.kstest(values, "norm").pvalue > 0.01
        assert abs(values.mean()) < 4 / np.sqrt(n)
        assert abs(values.var() - 1) < 4 * np.sqrt(2 / n)
        assert abs(stats.skew(values)) < 4 * np.sqrt(6 / n)
        assert abs(stats.kurtosis(values)) < 4 * np.sqrt(24 / n)
        assert 4 < np.abs(values).max() < 6.5


def test_noise_is_independent(normals):
    w, v = normals
    bound = 4 / np.sqrt(w.size)
    pairs = {
        "process and measurement": (w, v),
        "squares of both": (w**2 - 1, v**2 - 1),
        "successive steps": (w[:-1], w[1:]),
        "the pair of the last step": (v[:-1], w[1:]),
        "neighbouring rows": (w[:, :-1], w[:, 1:]),
    }
    for name, (first, second) in pairs.items():
        assert abs(np.corrcoef(first.ravel(), second.ravel())[0, 1]) < bound, name


def test_a_branch_is_a_stream_of_its_own_for_the_same_numbers():
    entropy = np.random.default_rng(5).integers(0, 2**32, size=4, dtype=np.uint32).tolist()
    for branch, key in {"train": (), "validation": (1,), "test": (2,)}.items():
        expected = np.random.SFC64(np.random.SeedSequence(entropy, spawn_key=key)).state["state"]["state"]
        words = new_stream_words(np.random.default_rng(5), branch).view(np.uint64)
        np.testing.assert_array_equal(words, expected)


def test_streams_of_different_branches_never_meet():
    starts = [new_stream_words(np.random.default_rng(seed), branch) for branch in SEED_BRANCHES for seed in range(1000)]
    for word in range(3):
        assert len({int(start.view(np.uint64)[word]) for start in starts}) == len(starts)


def test_streams_of_different_seeds_differ():
    starts = [new_stream_words(np.random.default_rng(seed)).view(np.uint64) for seed in range(2000)]
    for word in range(3):
        assert len({int(start[word]) for start in starts}) == len(starts)
    draws = {numpy_stream(start).random_raw() for start in starts}
    assert len(draws) == len(starts)
