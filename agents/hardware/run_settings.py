"""Settings of a run on hardware: policy, number of samples, safety bound and watchdog (``duffing-env run``)."""

from __future__ import annotations

from dataclasses import dataclass, fields

#: Shortest silence after which the watchdog acts, where none is given [s].
_MIN_WATCHDOG_TIMEOUT = 2.0


@dataclass(frozen=True)
class RunSettings:
    """Settings of a run.

    Attributes:
        policy: efe (the planner) or the name of a signal; without a block, the name of any policy.
        samples: number of inputs to play, in all.
        block: number of inputs that are chosen and played at once; None: each input is chosen by itself, against the
            clock.
        bound: largest probability with which a block, or a whole signal, may take the output out of its range.
        listen: number of samples without input at the start, from which the rig's state is estimated.
        watchdog: seconds of silence after which the plant zeroes its input; None: 2 s or 20 sampling steps, whichever
            is longer, plus twice the length of a block.
        no_watchdog: whether to run a plant that has no watchdog.
        stale: number of outputs in a row, missing, late or equal to the one before, that ends the run; 0: no number.
        seed: seed of the policy, and of the systems that are drawn from the belief.

    Raises:
        ValueError: naming the argument, the value and the remedy.
    """

    policy: str = "efe"
    samples: int = 256
    block: int | None = None
    bound: float = 0.05
    listen: int = 16
    watchdog: float | None = None
    no_watchdog: bool = False
    stale: int = 32
    seed: int = 0

    def __post_init__(self) -> None:
        # The defaults are made for --help too, which imports nothing that computes.
        if any(getattr(self, field.name) is not field.default for field in fields(self)):
            self._check()

    def _check(self) -> None:
        from agents.predict_argument_checks import MAX_SAMPLES
        from estimator.support.argument_checks import (
            MAX_SEED,
            MIN_MAGNITUDE,
            check_bool,
            check_integer,
            check_number,
            short_repr,
        )

        ranges = {
            "samples": (1, MAX_SAMPLES), "listen": (1, MAX_SAMPLES), "stale": (0, MAX_SAMPLES),
            "block": (8, MAX_SAMPLES), "seed": (0, MAX_SEED),
        }  # fmt: skip
        for name, (least, most) in ranges.items():
            if name != "block" or self.block is not None:
                check_integer(name, getattr(self, name), most, least)
        if not isinstance(self.policy, str):
            raise ValueError(f"policy must be a name, but is {short_repr(self.policy)}; see agents.POLICIES")
        check_number("bound", self.bound, MIN_MAGNITUDE, 1 - MIN_MAGNITUDE, "0.05 is usual")
        if self.watchdog is not None:
            check_number("watchdog", self.watchdog, remedy="it is in seconds")
        check_bool("no_watchdog", self.no_watchdog)

    def watchdog_timeout(self, sampling_step: float) -> float | None:
        """Seconds of silence after which the watchdog acts; None where there is no watchdog."""
        if self.no_watchdog:
            return None
        return self.watchdog or max(_MIN_WATCHDOG_TIMEOUT, 20 * sampling_step) + 2 * (self.block or 0) * sampling_step
