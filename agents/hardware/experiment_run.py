"""`run_experiment`: an experiment on a rig, from arming the plant to parameters with credible intervals."""

from __future__ import annotations

import json
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
from agents.hardware.safety_session import SafetyStop, Session, StopReason, check_safety_settings
from agents.hardware.sample_loop import SampleLoop, inputs_from_policy, inputs_from_signal
from agents.interruption import Interrupted
from agents.planning.open_loop.posterior_samples import MonteCarloSystems
from agents.policies import Policy, make_policy
from agents.policies.signals import SignalPolicy
from agents.user_code import attribute_user_errors
from estimator.belief import Belief
from estimator.identification.data.text_tables import read_table
from estimator.identification.diagnostics.equation_checks import disturbance_message
from estimator.identification.fitting.posterior_belief import disturbance_std
from estimator.rigs.rig import Rig
from estimator.saving import save_estimator
from estimator.support.file_io import write_atomically

#: Number of measured outputs from which the noises are estimated well enough for `_prior_conflict_warning`.
_MIN_OUTPUTS_FOR_NOISE = 64

#: Outcome of a run that played all its samples.
COMPLETE = "complete"

#: Outcome of a run that played all its samples, but whose input could not be zeroed at the end.
NOT_ZEROED = "zero"


@dataclass(frozen=True, eq=False)
class RunResult:
    """The result of a run.

    Attributes:
        rig: of the run.
        folder: with manifest.json, samples.csv, events.jsonl, parameters.json and estimator.npz.
        outcome: ``complete``; a `agents.hardware.safety_session.StopReason`, such as ``range``; the name of a signal;
            or ``zero`` where all samples were played, but the input could not be zeroed.
        message: the reason where the run is not complete; then warnings, if any.
        belief: at the end, given all measurements.
        late_ticks: number of ticks that were missed or late, silent ones included.
        exit_status: for a shell: 0; 1 after a safety stop or ``zero``; 128 + its number after a signal.
    """

    rig: Rig
    folder: Path
    outcome: str
    message: str
    belief: Belief
    late_ticks: int
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
        """Parameter to its central credible interval of this probability."""
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
    """Run an experiment, and identify the rig while it goes on.

    The plant is armed when everything is compiled and the output was measured in its range, and left with its input at
    zero, whatever happens. SIGINT, SIGTERM and SIGHUP end the run in order, where this is the main thread.

    Args:
        rig: with the limit of the input, the range of the output, a delay of 0 or more and ``zero_order``.
        plant: of the rig (`agents.hardware.plant_interface.HardwarePlant`).
        out: a new or empty folder.
        settings: of the run; None: the defaults of `RunSettings`.
        prior: the belief before the run, such as ``identify(...).belief``; None: by the rig's guess.
        clock: None: the machine's clock.
        on_progress: called with the number of samples so far.

    Returns:
        The result, also of a run that a safety stop or a signal ended.

    Raises:
        ValueError: for a bad rig, plant, folder or setting, before anything is armed; or where the belief overflows in
            the run.

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
        >>> result.outcome, result.late_ticks, plant.applied
        ('complete', 0, 0.0)
        >>> mean, std = result.parameters["m"]
        >>> bool(abs(mean - 0.42) < 4 * std < 0.04)
        True
    """
    run = _prepare_run(Rig.from_any(rig), check_plant(plant), settings or RunSettings(), prior, clock or RealClock())
    recording = Recording(out, _manifest(run), run.rig)
    session = Session(run.plant, run.rig, recording.log_event, run.watchdog_timeout, run.settings.stale)
    ending = _play(run, session, recording, on_progress or (lambda samples: None))
    return _finish_run(run, session, recording, ending)


@dataclass(frozen=True)
class _PreparedRun:
    """Everything that is made before the plant is armed; ``designer`` is None for a policy that chooses each sample."""

    rig: Rig
    plant: HardwarePlant
    settings: RunSettings
    clock: Clock
    watchdog_timeout: float | None
    run_estimator: RunEstimator
    env_view: EnvView
    policy: Policy
    designer: BlockDesigner | None


@dataclass
class _Ending:
    """How the played part of a run ended, with the fields of `RunResult`."""

    outcome: str = ""
    message: str = ""
    exit_status: int = 1
    late_ticks: int = 0
    lost_outputs_warning: str = ""


def _prepare_run(
    rig: Rig, plant: HardwarePlant, settings: RunSettings, prior: Belief | None, clock: Clock
) -> _PreparedRun:
    """Check rig and plant, make estimator and policy, and compile."""
    run_estimator, watchdog_timeout = RunEstimator(rig, prior), settings.watchdog_timeout(rig.step)
    check_safety_settings(rig, plant, watchdog_timeout)
    env_view = EnvView(rig, run_estimator.belief, settings.samples)
    with attribute_user_errors(settings.policy, "policy"):
        policy = make_policy(settings.policy, env_view, seed=settings.seed)  # type: ignore[arg-type]
        designer = block_designer(policy, env_view) if settings.block or isinstance(policy, SignalPolicy) else None
        _compile_ahead(run_estimator, env_view, designer, policy, settings)
    return _PreparedRun(rig, plant, settings, clock, watchdog_timeout, run_estimator, env_view, policy, designer)


def _manifest(run: _PreparedRun) -> dict[str, object]:
    """The entries of manifest.json that are known before the run."""
    return {
        "command": sys.argv,
        "rig": run.rig.to_dict(),
        "plan": asdict(run.settings),
        "watchdog": run.watchdog_timeout,
        "plant": repr(run.plant)[:200],
    }


def _play(run: _PreparedRun, session: Session, recording: Recording, on_progress: Callable[[int], None]) -> _Ending:
    """Play the run; a safety stop or a signal is an ending, any other exception closes the recording and goes on."""
    ending = _Ending()
    try:
        with session:
            play = _play_blocks if run.settings.block else _play_samples
            play(run, session, recording, on_progress, ending)
        ending.outcome, ending.exit_status = COMPLETE, 0
    except SafetyStop as stop:
        ending.outcome, ending.message = stop.reason.value, str(stop)
        if ending.late_ticks and stop.reason is StopReason.RANGE:
            ending.message += (
                f"; {ending.late_ticks} ticks of the clock were missed before, in which the input stayed as it was"
            )
    except Interrupted as interruption:
        ending.outcome, ending.exit_status = str(interruption), 128 + interruption.signum
        ending.message = f"stopped by {interruption}"
    except BaseException as error:
        message = _join_messages(session.zeroing_error, f"{type(error).__name__}: {error}")
        with suppress(OSError):  # a full disk may be the error
            recording.close(how="error", message=message, late=ending.late_ticks)
        raise
    return ending


def _play_blocks(
    run: _PreparedRun, session: Session, recording: Recording, on_progress: Callable[[int], None], ending: _Ending
) -> None:
    """Listen, then design and play block by block; a plant that plays blocks misses no tick."""
    settings, rng = run.settings, np.random.default_rng(run.settings.seed)
    assert run.designer is not None
    assert settings.block
    loop = BlockLoop(session, run.run_estimator, run.env_view, recording, run.clock, run.rig.step, settings.bound, rng)
    loop.listen(settings.listen)
    loop.play(run.designer, settings.samples, settings.block, on_progress)


def _play_samples(
    run: _PreparedRun, session: Session, recording: Recording, on_progress: Callable[[int], None], ending: _Ending
) -> None:
    """Listen, design a signal where the policy is one, arm, and play against the clock."""
    settings, rng = run.settings, np.random.default_rng(run.settings.seed)
    loop = SampleLoop(session, run.run_estimator, recording, run.clock, run.rig.step)
    try:
        loop.listen(settings.listen)
        if run.designer is None:
            next_input = inputs_from_policy(run.policy, run.env_view, run.run_estimator)
        else:
            signal = design_safe_block(
                run.designer,
                run.run_estimator,
                run.env_view,
                settings.samples,
                settings.bound,
                rng,
                recording.log_event,
            )
            next_input = inputs_from_signal(signal)
        session.arm()
        loop.play(next_input, settings.samples, on_progress)
    finally:
        ending.late_ticks, ending.lost_outputs_warning = loop.late_ticks, loop.warning


def _finish_run(run: _PreparedRun, session: Session, recording: Recording, ending: _Ending) -> RunResult:
    """Join messages and warnings, close the recording, and write parameters.json and estimator.npz."""
    outcome, exit_status, belief = ending.outcome, ending.exit_status, run.run_estimator.belief
    if session.zeroing_error:
        outcome, exit_status = NOT_ZEROED if exit_status == 0 else outcome, exit_status or 1
    # A run with the outcome late has the lost outputs in its message.
    warnings = (
        "" if outcome == StopReason.LATE else ending.lost_outputs_warning,
        _prior_conflict_warning(run.rig, belief, recording.samples_path),
    )
    message = _join_messages(session.zeroing_error, ending.message, *warnings)
    recording.close(how=outcome, message=message, late=ending.late_ticks)
    result = RunResult(run.rig, recording.folder, outcome, message, belief, ending.late_ticks, exit_status)
    _write_result_files(result, run.run_estimator)
    return result


def _join_messages(*messages: str) -> str:
    return "; ".join(filter(None, messages))


def _prior_conflict_warning(rig: Rig, belief: Belief, samples_path: Path) -> str:
    """A warning where the samples contradict the prior, so that the belief explains them by noise; else an empty text.

    A belief that is sure of wrong coefficients keeps them. Only of one input is it known which force the noise is.
    """
    if len(rig.inputs) > 1 or "gain" not in belief.model.coefficients:
        return ""
    with samples_path.open(encoding="utf-8") as lines:
        if sum(1 for _ in lines) <= _MIN_OUTPUTS_FOR_NOISE:
            return ""
    table = read_table(samples_path, rig.only_input.column, rig.output.column)
    u, y = table.inputs, table.columns[table.output_column]
    if np.isfinite(y).sum() < _MIN_OUTPUTS_FOR_NOISE:
        return ""
    warning = disturbance_message(rig.only_input, float(np.sqrt(np.nanmean(u**2))), disturbance_std(belief))
    if not warning:
        return ""
    return f"{warning}; the equation does not hold, or the prior is wrong: identify {samples_path} alone"


def _compile_ahead(
    run_estimator: RunEstimator,
    env_view: EnvView,
    designer: BlockDesigner | None,
    policy: Policy,
    settings: RunSettings,
) -> None:
    """Compile the functions that the run will call: a plant must not wait for the compiler with its input on."""
    no_input = np.zeros(len(env_view.max_inputs))
    env_view.belief = run_estimator.predict_ahead(no_input if len(no_input) > 1 else 0.0)
    rng = np.random.default_rng(0)
    if designer is None:
        # A missing output takes more steps than a measured one.
        policy.predict(env_view.observation(no_input, np.nan, 0), None, deterministic=True)
        return
    futures = MonteCarloSystems(run_estimator.online.model, run_estimator.draw_systems(rng), 1.0, rng)
    if settings.block:
        run_estimator.compile_block_update()
    if settings.block and not isinstance(policy, SignalPolicy):
        designer.design_block(settings.block, futures, settings.bound)
    futures.violation_probability(np.zeros(1))


def _write_result_files(result: RunResult, run_estimator: RunEstimator) -> None:
    """Write parameters.json, and the estimator at the end as estimator.npz."""
    intervals = result.interval(0.9)
    parameters = {
        name: {"mean": mean, "std": std, "low": intervals[name][0], "high": intervals[name][1], "unit": unit}
        for name, (mean, std, unit) in result.belief.parameters().items()
    }
    write_atomically(result.folder / "parameters.json", json.dumps(parameters, indent=1) + "\n")
    save_estimator(run_estimator.online, result.folder / "estimator.npz")
