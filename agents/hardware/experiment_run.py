"""`run`: an experiment on a rig, from arming to parameters with intervals."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from agents.hardware.block_loop import BlockDesigner, BlockLoop, block_designer, design_safe_block
from agents.hardware.clock import Clock, RealClock
from agents.hardware.env_view import EnvView
from agents.hardware.plant_interface import HardwarePlant, check_plant
from agents.hardware.recording import Recording
from agents.hardware.run_estimator import RunEstimator
from agents.hardware.run_settings import RunSettings
from agents.hardware.safety_session import SafetyStop, Session, check_safety_settings
from agents.hardware.sample_loop import InputFunction, SampleLoop, inputs_from_policy, inputs_from_signal
from agents.interruption import Interrupted
from agents.planning.open_loop.posterior_samples import MonteCarloSystems
from agents.policies import make_policy
from agents.policies.signals import SignalPolicy
from agents.user_code import attribute_user_errors
from estimator.belief import Belief
from estimator.identification.data.text_tables import read_table
from estimator.identification.diagnostics.equation_checks import disturbance_message
from estimator.identification.fitting.posterior_belief import disturbance_std
from estimator.rigs.rig import Rig
from estimator.saving import save_estimator
from estimator.support.file_io import write_atomically

#: Fewer outputs do not tell how much noise there is.
_MIN_OUTPUTS_FOR_NOISE = 64


@dataclass(frozen=True, eq=False)
class RunResult:
    """How a run went.

    Attributes:
        rig: of the run.
        folder: with manifest.json, samples.csv, events.jsonl, parameters.json and estimator.npz.
        ended: ``complete``; ``range``, ``stale``, ``late``, ``input``, ``plant`` or ``designer`` for what tripped
            (`agents.hardware.safety_session.SafetyStop`); the name of a signal; or ``zero`` where all was complete, but the input
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


def run_experiment(
    rig: Rig | Mapping[str, Any] | str | Path,
    plant: HardwarePlant,
    out: str | Path,
    settings: RunSettings | None = None,
    *,
    prior: Belief | None = None,
    clock: Clock | None = None,
    on_progress: Callable[[int], None] | None = None,
) -> RunResult:
    """Run an experiment, and identify while it goes on.

    The plant is armed when everything is compiled and the output was seen to be in its range, and left with its input
    at zero, whatever happens. SIGINT, SIGTERM and SIGHUP end the run in order, where this is the main thread.

    Args:
        rig: with the limit of the input, the range of the output, a delay of 0 or more and ``zero_order``.
        plant: of the rig (`agents.hardware.plant_interface.HardwarePlant`).
        out: a new or empty folder.
        settings: what to do; that of `Plan` where it is None.
        prior: what is believed before, such as ``identify(...).belief``; the rig's guess where it is None.
        clock: the machine's where it is None.
        on_progress: is called with the number of samples, as they come in.

    Returns:
        How it went: also where it was ended by a trip or a signal.

    Raises:
        ValueError: naming what is wrong with rig, plant, folder or plan, before anything is armed; or where the belief
            overflows in the run.

    Example:
        >>> import tempfile
        >>> from agents.hardware.clock import JumpingClock
        >>> from agents.hardware.experiment_run import RunSettings, run_experiment
        >>> from agents.hardware.simulated_plant import SimulatedPlant
        >>> from estimator import Channel, Rig
        >>> rig = Rig(1e-3, input=Channel("N", limit=20.0, noise=0.02), output=Channel("m", range=0.03, noise=5e-6),
        ...           guess={"m": (0.3, 0.5), "c": (0.1, 2.0), "a": (1e3, 5e3), "b": (0.0, 1e8)})
        >>> clock = JumpingClock()
        >>> plant = SimulatedPlant(rig, {"m": 0.42, "c": 0.6, "a": 2500.0, "b": 4e7}, clock=clock)
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     result = run_experiment(rig, plant, folder, RunSettings(policy="prbs", samples=256), clock=clock)
        >>> result.ended, result.late, plant.applied
        ('complete', 0, 0.0)
        >>> mean, std = result.parameters["m"]
        >>> bool(abs(mean - 0.42) < 4 * std < 0.04)
        True
    """
    rig, settings, clock = Rig.from_any(rig), settings or RunSettings(), clock or RealClock()
    plant, on_progress = check_plant(plant), on_progress or (lambda samples: None)
    run_estimator, watchdog_timeout = RunEstimator(rig, prior), settings.watchdog_timeout(rig.step)
    check_safety_settings(rig, plant, watchdog_timeout)
    env_view = EnvView(rig, run_estimator.belief, settings.samples)
    with attribute_user_errors(settings.policy, "policy"):
        policy = make_policy(settings.policy, env_view, seed=settings.seed)  # type: ignore[arg-type]
        designer = block_designer(policy, env_view) if settings.block or isinstance(policy, SignalPolicy) else None
        next_input: InputFunction | None = None if designer else inputs_from_policy(policy, env_view, run_estimator)
        _compile_ahead(run_estimator, env_view, designer, policy, settings)
    manifest = {"command": sys.argv, "rig": rig.to_dict(), "plan": asdict(settings), "watchdog": watchdog_timeout}
    recording = Recording(out, {**manifest, "plant": repr(plant)[:200]}, rig)
    session = Session(plant, rig, recording.log_event, watchdog_timeout, settings.stale)
    message, lost_outputs_warning, status, late = "", "", 1, 0
    try:
        with session:
            rng = np.random.default_rng(settings.seed)
            if settings.block:
                assert designer is not None
                block_loop = BlockLoop(
                    session, run_estimator, env_view, recording, clock, rig.step, settings.bound, rng
                )
                block_loop.listen(settings.listen)
                block_loop.play(designer, settings.samples, settings.block, on_progress)
            else:
                sample_loop = SampleLoop(session, run_estimator, recording, clock, rig.step)
                try:
                    sample_loop.listen(settings.listen)
                    if designer is not None:
                        log_event = recording.log_event
                        next_input = inputs_from_signal(
                            design_safe_block(
                                designer, run_estimator, env_view, settings.samples, settings.bound, rng, log_event
                            )
                        )
                    assert next_input is not None
                    session.arm()
                    sample_loop.play(next_input, settings.samples, on_progress)
                finally:
                    late, lost_outputs_warning = sample_loop.late, sample_loop.warning
        outcome, status = "complete", 0
    except SafetyStop as stop:
        outcome, message = stop.reason, str(stop)
        if late and outcome == "range":
            message += f"; {late} ticks of the clock were missed before, in which the input stayed as it was"
    except Interrupted as stopped:
        outcome, message, status = str(stopped), f"stopped by {stopped}", 128 + stopped.signum
    except BaseException as error:
        message = _join_messages(session.failure, f"{type(error).__name__}: {error}")
        with suppress(OSError):  # a full disk may be what ended it
            recording.close(how="error", message=message, late=late)
        raise
    if session.failure:
        outcome, status = "zero" if status == 0 else outcome, status or 1
    # That outputs came late is what ended such a run.
    warnings = (
        "" if outcome == "late" else lost_outputs_warning,
        _prior_conflict_warning(rig, run_estimator.belief, recording.samples),
    )
    message = _join_messages(session.failure, message, *warnings)
    recording.close(how=outcome, message=message, late=late)
    result = RunResult(rig, Path(out), outcome, message, run_estimator.belief, late, status)
    _write_result_files(result, run_estimator)
    return result


def _join_messages(*messages: str) -> str:
    return "; ".join(filter(None, messages))


def _prior_conflict_warning(rig: Rig, belief: Belief, samples_path: Path) -> str:
    """Says it where the samples speak against what was believed before them, so that noise explains them; else nothing.

    A belief that is sure of wrong coefficients keeps them.
    """
    with samples_path.open(encoding="utf-8") as lines:
        if sum(1 for _ in lines) <= _MIN_OUTPUTS_FOR_NOISE:
            return ""
    table = read_table(samples_path, rig.input.column, rig.output.column)
    u, y = table.inputs, table.columns[table.output_column]
    if np.isfinite(y).sum() < _MIN_OUTPUTS_FOR_NOISE:
        return ""
    warning = disturbance_message(rig.input, float(np.sqrt(np.nanmean(u**2))), disturbance_std(belief))
    return (
        warning
        and f"{warning}; the equation does not hold, or what was believed before is wrong: identify {samples_path} alone"
    )


def _compile_ahead(
    run_estimator: RunEstimator, env_view: EnvView, designer: BlockDesigner | None, policy: Any, settings: RunSettings
) -> None:
    """Compile what the run will call: a plant must not wait for the compiler with its input on."""
    env_view.belief, rng = run_estimator.predict_ahead(0.0), np.random.default_rng(0)
    if designer is None:
        # A missing output is the longer way.
        policy.predict(env_view.observation(0.0, np.nan, 0), None, deterministic=True)
        return
    futures = MonteCarloSystems(run_estimator.online.model, run_estimator.draw_systems(rng), 1.0, rng)
    if settings.block:
        run_estimator.compile_block_update()
    if settings.block and not isinstance(policy, SignalPolicy):
        designer.block(settings.block, futures, settings.bound)
    futures.violation_probability(np.zeros(1))


def _write_result_files(result: RunResult, run_estimator: RunEstimator) -> None:
    """Parameters as JSON, and the estimator as it is at the end."""
    import json

    intervals = result.interval(0.9)
    parameters = {
        name: {"mean": mean, "std": std, "low": intervals[name][0], "high": intervals[name][1], "unit": unit}
        for name, (mean, std, unit) in result.belief.parameters().items()
    }
    write_atomically(result.folder / "parameters.json", json.dumps(parameters, indent=1) + "\n")
    save_estimator(run_estimator.online, result.folder / "estimator.npz")
