"""Write an excitation as CSV, for a real signal generator.

$ python -m agents.policies.export prbs-4 --samples 1024 --output prbs.csv
$ python -m agents.policies.export multisine --max-rms 0.0222 --output multisine.csv

The file has the columns ``t [s]`` and ``u [V]``; each input is held for a sample of 1.6384 ms (610.35 Hz).
"""

from __future__ import annotations

import difflib
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro
from numpy.typing import NDArray

from agents.cli import run_script
from agents.policies.excitations import EXCITATIONS
from agents.policies.feedback import FEEDBACK
from agents.policies.signals import DEFAULT_MAX_INPUT, DEFAULT_SAMPLES, Limits
from estimator.files import write_atomically
from estimator.parameters import SAMPLING_STEP


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
        samples: Its length, at least 1; multisines need 5.
        max_input: The amplitude limit, in volts, positive.
        max_rms: The largest root mean square, in volts, positive; None: no limit. See `Limits.fit`.
        seed: The seed of the draw, 0 or more.

    Returns:
        The input in volts, shape `(samples,)`.

    Raises:
        ValueError: An argument is out of its range, or there is no excitation of this name.
    """
    if name not in EXCITATIONS:
        nearest = difflib.get_close_matches(name, EXCITATIONS, n=1)
        hint = f"; did you mean {nearest[0]!r}?" if nearest else ""
        if name in FEEDBACK:
            hint = "; it answers to what an oscillator does, so it must be played: use agents.make_policy"
        raise ValueError(f"name must be one of {', '.join(EXCITATIONS)}, but it is {name!r}{hint}")
    if samples < 1:
        raise ValueError(f"samples must be 1 or more, but it is {samples}; {DEFAULT_SAMPLES} last 1.7 s")
    if seed < 0:
        raise ValueError(f"seed must be 0 or more, but it is {seed}; any whole number from 0 on gives a signal")
    limits = Limits(max_input, max_rms)
    generator = np.random.default_rng(np.random.SeedSequence(seed).spawn(1)[0])
    return max_input * limits.fit(EXCITATIONS[name](max_input)(generator, samples))


def export_signal(name: str, path: str | Path, **limits: Any) -> NDArray[np.float64]:
    """Writes an excitation as CSV, in one piece: columns ``t [s]`` and ``u [V]``, a row for each sample.

    Numbers have all their digits, so that reading them gives the very signal.

    Args:
        name: As `draw_signal`.
        path: The file. Its folder is made where it is missing; a file of this name is replaced.
        limits: Further arguments of `draw_signal`.

    Returns:
        The input in volts, shape `(samples,)`.

    Raises:
        ValueError: As `draw_signal`; nothing is written then.
        OSError: The file cannot be written.
    """
    volts = draw_signal(name, **limits)
    times = (SAMPLING_STEP * np.arange(len(volts))).tolist()
    rows = [f"{time!r},{value!r}" for time, value in zip(times, volts.tolist(), strict=True)]
    write_atomically(Path(path), "\n".join(["t [s],u [V]", *rows, ""]))
    return volts


@dataclass(frozen=True)
class Config:
    """Write an excitation as CSV, for a real signal generator."""

    name: Annotated[str, tyro.conf.Positional]
    """Name of the excitation."""
    output: Path
    """The file that is written."""
    samples: int = DEFAULT_SAMPLES
    """Its length."""
    max_input: float = DEFAULT_MAX_INPUT
    """The amplitude limit in volts."""
    max_rms: float | None = None
    """The largest root mean square in volts."""
    seed: int = 0
    """Seed of the draw."""


def main(config: Config) -> None:
    """Write it, and say what it is."""
    limits = {name: value for name, value in vars(config).items() if name not in ("name", "output")}
    volts = export_signal(config.name, config.output, **limits)
    peak, rms = np.abs(volts).max(), np.sqrt(np.mean(volts**2))
    seconds = volts.size * SAMPLING_STEP
    print(f"{config.output}: {volts.size} samples, {seconds:.4g} s, peak {peak:.4g} V, RMS {rms:.4g} V")


if __name__ == "__main__":
    run_script(main, Config, __doc__)
