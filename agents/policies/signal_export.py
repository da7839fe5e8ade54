"""Export of excitation signals as CSV, for a signal generator: ``duffing-env export``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agents.policies.excitations import EXCITATIONS
from agents.policies.feedback import FEEDBACK
from agents.policies.signals import DEFAULT_MAX_INPUT, DEFAULT_SAMPLES, InputLimits
from agents.predict_argument_checks import MAX_SAMPLES
from estimator.rigs.silverbox_constants import SILVERBOX_SAMPLING_STEP
from estimator.support.argument_checks import MAX_SEED, check_integer, did_you_mean, short_repr
from estimator.support.file_io import write_atomically


def draw_signal(
    name: str,
    *,
    samples: int = DEFAULT_SAMPLES,
    max_input: float = DEFAULT_MAX_INPUT,
    max_rms: float | None = None,
    seed: int = 0,
) -> NDArray[np.float64]:
    """Draws an excitation within its limits.

    It is, up to the float32 rounding of actions, the first signal that `make_policy(name, env, seed=seed)` plays to
    the first environment, where `env` has these limits and this horizon.

    Args:
        name: A name in `agents.policies.excitations.EXCITATIONS`.
        samples: Its length, 1 to `MAX_SAMPLES`; multisines need 5.
        max_input: The amplitude limit, in volts, positive.
        max_rms: The largest root mean square, in volts, positive; None: no limit. See `InputLimits.to_actions`.
        seed: The seed of the draw, 0 or more.

    Returns:
        The input in volts, shape `(samples,)`.

    Raises:
        ValueError: An argument is out of its range, or there is no excitation of this name.
    """
    if not isinstance(name, str) or name not in EXCITATIONS:
        remedy = did_you_mean(name, EXCITATIONS)
        if str(name) in FEEDBACK:
            remedy = "; it is feedback on an oscillator, so it must be played: use agents.make_policy"
        raise ValueError(f"name must be one of {', '.join(EXCITATIONS)}, but it is {short_repr(name)}{remedy}")
    check_integer("samples", samples, MAX_SAMPLES)
    check_integer("seed", seed, MAX_SEED, 0)
    limits = InputLimits(max_input, max_rms)
    generator = np.random.default_rng(np.random.SeedSequence(seed).spawn(1)[0])
    return max_input * limits.to_actions(EXCITATIONS[name](max_input)(generator, samples))


def export_signal(name: str, path: str | Path, **limits: Any) -> NDArray[np.float64]:
    """Writes an excitation as CSV, in one piece: columns ``t [s]`` and ``u [V]``, a row for each sample.

    Numbers have all their digits, so that reading them gives the very signal.

    The folder is made where it is missing; a file of this name is replaced.

    Returns:
        The input in volts, shape `(samples,)`.

    Raises:
        ValueError: As `draw_signal`, whose arguments the others are; nothing is written then.
        OSError: The file cannot be written.
    """
    volts = draw_signal(name, **limits)
    times = (SILVERBOX_SAMPLING_STEP * np.arange(len(volts))).tolist()
    rows = [f"{time!r},{value!r}" for time, value in zip(times, volts.tolist(), strict=True)]
    write_atomically(Path(path), "\n".join(["t [s],u [V]", *rows, ""]))
    return volts
