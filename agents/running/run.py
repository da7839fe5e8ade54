"""`run`: an experiment on a rig, from arming to parameters with intervals."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from agents.loading import of_ones_own
from agents.planner.futures import Futures
from agents.policies import make_policy
from agents.policies.signals import SignalPolicy
from agents.running.blocks import Blocks, Design, design_of, designed
from agents.running.clock import Clock, RealClock
from agents.running.follower import Follower
from agents.running.observed import Observed
from agents.running.plan import Plan
from agents.running.plant import Plant, check_plant
from agents.running.recording import Recording
from agents.running.samples import Chooser, Ticker, asking, playing
from agents.running.session import Session, Tripped, check_session
from agents.stopping import Stopped
from estimator.belief import Belief
from estimator.files import write_atomically
from estimator.identification.beliefs import disturbance
from estimator.identification.checks import disturbed
from estimator.identification.tables import read_table
from estimator.rig import Rig
from estimator.saving import save_estimator

#: Fewer outputs do not tell how much noise there is.
_FEWEST = 64


@dataclass(frozen=True, eq=False)
class Run:
    """How a run went.

    Attributes:
        rig: of the run.
        folder: with manifest.json, samples.csv, events.jsonl, parameters.json and estimator.npz.
        ended: ``complete``; ``range``, ``stale``, ``late``, ``input``, ``plant`` or ``design`` for what tripped
            (`agents.running.session.Tripped`); the name of a signal; or ``zero`` where all was complete, but the input
            could not be zeroed.
        message: why, where it is not complete; then warnings, if any.
        belief: at the end, from all that was measured.
        late: ticks that were missed, those of the silence included.
        exit_status: for a shell: 0, 1 after a trip or ``zero``, 128 + its number after a signal.
    """

    rig: Rig
    folder: Path
    ended: str
    message: str
    belief: Belief
    late: int
    exit_status: int

    @property
    def parameters(self) -> dict[str, tuple[float, float]]:
        """Parameter to mean and standard deviation, in the rig's units."""
        return {name: (mean, std) for name, (mean, std, _) in self.belief.parameters().items()}

    @property
    def units(self) -> dict[str, str]:
        """Parameter to its unit."""
        return {name: unit for name, (_, _, unit) in self.belief.parameters().items()}

    def interval(self, probability: float = 0.9) -> dict[str, tuple[float, float]]:
        """Parameter to the central interval that holds it with a probability."""
        return self.belief.interval(probability)


def run(
    rig: Rig | Mapping[str, Any] | str | Path,
    plant: Plant,
    out: str | Path,
    plan: Plan | None = None,
    *,
    prior: Belief | None = None,
    clock: Clock | None = None,
    told: Callable[[int], None] | None = None,
) -> Run:
    """Run an experiment, and identify while it goes on.

    The plant is armed when everything is compiled and the output was seen to be in its range, and left with its input
    at zero, whatever happens. SIGINT, SIGTERM and SIGHUP end the run in order, where this is the main thread.

    Args:
        rig: with the limit of the input, the range of the output, a delay of 0 or more and ``zero_order``.
        plant: of the rig (`agents.running.plant.Plant`).
        out: a new or empty folder.
        plan: what to do; that of `Plan` where it is None.
        prior: what is believed before, such as ``identify(...).belief``; the rig's guess where it is None.
        clock: the machine's where it is None.
        told: is called with the number of samples, as they come in.

    Returns:
        How it went: also where it was ended by a trip or a signal.

    Raises:
        ValueError: naming what is wrong with rig, plant, folder or plan, before anything is armed; or where the belief
            overflows in the run.

    Example:
        >>> import tempfile
        >>> from agents.running.clock import JumpingClock
        >>> from agents.running.run import Plan, run
        >>> from agents.running.simulated import SimulatedPlant
        >>> from estimator import Channel, Rig
        >>> rig = Rig(1e-3, input=Channel("N", limit=20.0, noise=0.02), output=Channel("m", range=0.03, noise=5e-6),
        ...           guess={"m": (0.3, 0.5), "c": (0.1, 2.0), "a": (1e3, 5e3), "b": (0.0, 1e8)})
        >>> clock = JumpingClock()
        >>> plant = SimulatedPlant(rig, {"m": 0.42, "c": 0.6, "a": 2500.0, "b": 4e7}, clock=clock)
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     result = run(rig, plant, folder, Plan(policy="prbs", samples=256), clock=clock)
        >>> result.ended, result.late, plant.applied
        ('complete', 0, 0.0)
        >>> mean, std = result.parameters["m"]
        >>> bool(abs(mean - 0.42) < 4 * std < 0.04)
        True
    """
    rig, plan, clock = Rig.of(rig), plan or Plan(), clock or RealClock()
    plant, told = check_plant(plant), told or (lambda samples: None)
    follower, silence = Follower(rig, prior), plan.silence(rig.step)
    check_session(rig, plant, silence)
    observed = Observed(rig, follower.belief, plan.samples)
    with of_ones_own(plan.policy, "policy"):
        policy = make_policy(plan.policy, observed, seed=plan.seed)  # type: ignore[arg-type]
        design = design_of(policy, observed) if plan.block or isinstance(policy, SignalPolicy) else None
        choose: Chooser | None = None if design else asking(policy, observed, follower)
        _warm_up(follower, observed, design, policy, plan)
    described = {"command": sys.argv, "rig": rig.to_dict(), "plan": asdict(plan), "watchdog": silence}
    recording = Recording(out, {**described, "plant": repr(plant)[:200]}, rig)
    session = Session(plant, rig, recording.note, silence, plan.stale)
    message, lost, status, late = "", "", 1, 0
    try:
        with session:
            rng = np.random.default_rng(plan.seed)
            if plan.block:
                assert design is not None
                blocks = Blocks(session, follower, observed, recording, clock, rig.step, plan.bound, rng)
                blocks.listen(plan.listen)
                blocks.play(design, plan.samples, plan.block, told)
            else:
                ticker = Ticker(session, follower, recording, clock, rig.step)
                try:
                    ticker.listen(plan.listen)
                    if design is not None:
                        note = recording.note
                        choose = playing(designed(design, follower, observed, plan.samples, plan.bound, rng, note))
                    assert choose is not None
                    session.arm()
                    ticker.play(choose, plan.samples, told)
                finally:
                    late, lost = ticker.late, ticker.warning
        ended, status = "complete", 0
    except Tripped as trip:
        ended, message = trip.reason, str(trip)
        if late and ended == "range":
            message += f"; {late} ticks of the clock were missed before, in which the input stayed as it was"
    except Stopped as stopped:
        ended, message, status = str(stopped), f"stopped by {stopped}", 128 + stopped.signum
    except BaseException as error:
        message = _joined(session.failure, f"{type(error).__name__}: {error}")
        with suppress(OSError):  # a full disk may be what ended it
            recording.close(how="error", message=message, late=late)
        raise
    if session.failure:
        ended, status = "zero" if status == 0 else ended, status or 1
    # That outputs came late is what ended such a run.
    warnings = "" if ended == "late" else lost, _contradiction(rig, follower.belief, recording.samples)
    message = _joined(session.failure, message, *warnings)
    recording.close(how=ended, message=message, late=late)
    result = Run(rig, Path(out), ended, message, follower.belief, late, status)
    _write(result, follower)
    return result


def _joined(*messages: str) -> str:
    return "; ".join(filter(None, messages))


def _contradiction(rig: Rig, belief: Belief, samples: Path) -> str:
    """Says it where the samples speak against what was believed before them, so that noise explains them; else nothing.

    A belief that is sure of wrong coefficients keeps them.
    """
    with samples.open(encoding="utf-8") as lines:
        if sum(1 for _ in lines) <= _FEWEST:
            return ""
    table = read_table(samples, rig.input.column, rig.output.column)
    u, y = table.inputs, table.columns[table.y]
    if np.isfinite(y).sum() < _FEWEST:
        return ""
    said = disturbed(rig.input, float(np.sqrt(np.nanmean(u**2))), disturbance(belief))
    return (
        said and f"{said}; the equation does not hold, or what was believed before is wrong: identify {samples} alone"
    )


def _warm_up(follower: Follower, observed: Observed, design: Design | None, policy: Any, plan: Plan) -> None:
    """Compile what the run will call: a plant must not wait for the compiler with its input on."""
    observed.belief, rng = follower.ahead(0.0), np.random.default_rng(0)
    if design is None:
        # A missing output is the longer way.
        policy.predict(observed.observation(0.0, np.nan, 0), None, deterministic=True)
        return
    futures = Futures(follower.estimator.model, follower.drawn(rng), 1.0, rng)
    if plan.block:
        follower.practise()
    if plan.block and not isinstance(policy, SignalPolicy):
        design.block(plan.block, futures, plan.bound)
    futures.probability(np.zeros(1))


def _write(result: Run, follower: Follower) -> None:
    """Parameters as JSON, and the estimator as it is at the end."""
    import json

    low_high = result.interval(0.9)
    told = {
        name: {"mean": mean, "std": std, "low": low_high[name][0], "high": low_high[name][1], "unit": unit}
        for name, (mean, std, unit) in result.belief.parameters().items()
    }
    write_atomically(result.folder / "parameters.json", json.dumps(told, indent=1) + "\n")
    save_estimator(follower.estimator, result.folder / "estimator.npz")
