"""Random numbers inside the kernel: one SFC64 stream per environment, started from its ``np_random``.

The stream is NumPy's `numpy.random.SFC64`, bit for bit. Its four 64-bit words lie in float64 rows of the environment's
block, so that a copy of a block also copies the random numbers to come.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from estimator.compilation.elementary_functions import log
from estimator.compilation.scalar_jit import scalar_jit

_S3, _S11, _S12, _S24, _S40 = (np.uint64(n) for n in (3, 11, 12, 24, 40))
_COUNTER_STEP = np.uint64(1)
_UNIT_52 = 2.0**-52


#: Branches of the seeds with their spawn keys: no two branches share a stream, whatever the seeds.
SEED_BRANCHES: dict[str, tuple[int, ...]] = {"train": (), "validation": (1,), "test": (2,)}


def new_stream_words(generator: np.random.Generator, branch: str = "train") -> npt.NDArray[np.float64]:
    """The four words of a fresh stream, as float64 bits (4,): 128 bits drawn from ``generator``, in a branch."""
    entropy = generator.integers(0, 2**32, size=4, dtype=np.uint32)
    state = np.random.SFC64(np.random.SeedSequence(entropy.tolist(), spawn_key=SEED_BRANCHES[branch])).state
    words: npt.NDArray[np.uint64] = state["state"]["state"]
    return words.view(np.float64)


@scalar_jit
def float_to_word(bits):
    """The 64-bit word that a float64 row holds."""
    return np.float64(bits).view(np.uint64)


@scalar_jit
def word_to_float(word):
    """A 64-bit word as the bits of a float64, to lie in a row."""
    return np.uint64(word).view(np.float64)


@scalar_jit
def sfc64_next(a, b, c, counter):
    """One 64-bit draw of SFC64: the value and the next four words."""
    value = a + b + counter
    return value, b ^ (b >> _S11), c + (c << _S3), ((c << _S24) | (c >> _S40)) + value, counter + _COUNTER_STEP


@scalar_jit
def to_open_uniform(value):
    """A uniform number in (0, 1) from a draw: the middle of one of 2^52 equal intervals."""
    return (np.float64(np.int64(value >> _S12)) + 0.5) * _UNIT_52


@scalar_jit
def box_muller(uniform_1, uniform_2):
    """Two independent standard normal numbers from two uniform ones (Box and Muller 1958)."""
    radius = np.sqrt(-2.0 * log(uniform_1))
    turns = 4.0 * uniform_2
    quarter = np.int64(turns + 0.5)
    angle = (turns - quarter) * 1.5707963267948966
    z = angle * angle
    # Taylor polynomials on [-π/4, π/4]: truncation below 4e-13 of the cosine, 1e-16 of the sine.
    cosine = 1.0 - z * (0.5 - z * (1 / 24 - z * (1 / 720 - z * (1 / 40320 - z * (1 / 3628800 - z * (1 / 479001600))))))
    sine = 1 / 39916800 - z * (1 / 6227020800 - z * (1 / 1307674368000))
    sine = 1 / 120 - z * (1 / 5040 - z * (1 / 362880 - z * sine))
    sine = angle * (1.0 - z * (1 / 6 - z * sine))
    is_swapped = (quarter & 1) == 1
    cos_part = sine if is_swapped else cosine
    sin_part = cosine if is_swapped else sine
    cos_part = -cos_part if ((quarter + 1) & 2) == 2 else cos_part
    sin_part = -sin_part if (quarter & 2) == 2 else sin_part
    return radius * cos_part, radius * sin_part
