"""Hyperparameter search with Optuna: every trial is a whole training, scored on held-out systems.

The search folder holds ``study.log`` (Optuna's journal, of JSON lines), ``trials/NUMBER`` (the run folders) and
``best.toml``, which `train.py --settings` reads.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from agents.console_output import format_table, print_texts_and_tables
from agents.training.algorithms import hyperparameters_to_dict
from agents.training.heldout_evaluation import HELDOUT_SCORE, HeldOutScores, final_score
from agents.training.hyperparameters import track_name, write_hyperparameters
from agents.training.ray_tasks import run_on_ray
from agents.training.training_config import TrainConfig, claim_run_folder
from agents.training.training_run import train_or_resume
from estimator.support.file_io import locked_folder
from estimator.support.optional_dependencies import require_packages

if TYPE_CHECKING:
    from optuna import Study, Trial

#: File of the best hyperparameters, in the search folder.
BEST_HYPERPARAMETERS_FILE = "best.toml"

#: Evaluations of a trial, after each of which it may be pruned.
_EVALUATIONS_PER_TRIAL = 10

#: Trials in the table that is printed.
_N_TRIALS_SHOWN = 10


def tune_hyperparameters(config: TrainConfig, trials: int, *, on_ray: bool = False) -> Path:
    """Train with many sets of hyperparameters, and write the best set.

    The first trial has the hyperparameters of the configuration; a tree-structured Parzen estimator chooses the others
    (`AlgorithmSettings.sample_hyperparameters`). A trial whose score is below the median of the other trials at the
    same samples is pruned. The score is the mean log posterior gain on held-out systems at the end of a training.

    Args:
        config: of every trial, but for the hyperparameters that are searched.
        trials: number of trials in the end; a search that was stopped goes on in the same folder.
        on_ray: whether trials are tasks on a cluster, as many at once as it has processors, see
            `agents.training.ray_tasks`; all nodes must have access to the folder. The choices then depend on which
            trials are finished first.

    Returns:
        The file of the best hyperparameters.

    Raises:
        ModuleNotFoundError: without Optuna, or without Ray if ``on_ray``.
        ValueError: where the folder holds another search, or another process searches in it.
    """
    require_packages("optuna")
    if on_ray:
        require_packages("ray")
    folder = config.output or Path("runs") / f"tune-{config.algo}-{track_name(config.env).lower()}-{config.seed}"
    folder = folder.resolve()
    claim_run_folder(folder / "search.json", config)
    with locked_folder("output", folder):
        return _run_search(config, folder, trials, on_ray)


def _run_search(config: TrainConfig, folder: Path, trials: int, on_ray: bool) -> Path:
    """Search, or go on with a search."""
    from optuna.trial import TrialState

    study, n_finished = _open_study(config, folder)
    # Hyperparameters are chosen in this process, which has the scores of all finished trials.
    remaining_trials = (_next_trial(study, config) for _ in range(trials - n_finished))
    train_trial = partial(_train_trial, config, folder)
    for trial, score in (
        run_on_ray(train_trial, remaining_trials)
        if on_ray
        else ((trial, train_trial(trial)) for trial in remaining_trials)
    ):
        study.tell(trial, score, state=TrialState.PRUNED if score is None else TrialState.COMPLETE)
    best = replace(config.hyperparameters, **study.best_params)
    comment = f"{config.algo}, trial {study.best_trial.number} of {folder}: {HELDOUT_SCORE} {study.best_value:.3f} nat"
    write_hyperparameters(folder / BEST_HYPERPARAMETERS_FILE, config.env, best, comment)
    _print_best_trials(study)
    return folder / BEST_HYPERPARAMETERS_FILE


def _open_study(config: TrainConfig, folder: Path) -> tuple[Study, int]:
    """The study of the folder, with the first or an interrupted trial queued, and the number of finished trials."""
    import optuna
    import optuna.storages.journal
    from optuna.trial import TrialState

    optuna.logging.set_verbosity(optuna.logging.ERROR)  # it warns of a trial that a signal ended, with a traceback
    storage = optuna.storages.JournalStorage(optuna.storages.journal.JournalFileBackend(str(folder / "study.log")))
    # A folder that was renamed holds the study of its first name.
    name = next(iter(optuna.study.get_all_study_names(storage)), folder.name)
    study = optuna.create_study(storage=storage, study_name=name, load_if_exists=True, direction="maximize")
    old_trials = study.get_trials(deepcopy=False)
    study.sampler = optuna.samplers.TPESampler(
        seed=int(np.random.SeedSequence((config.seed, len(old_trials))).generate_state(1)[0])
    )
    study.pruner = optuna.pruners.MedianPruner(n_warmup_steps=2 * _steps_between_evaluations(config))
    if not old_trials:
        study.enqueue_trial({k: v for k, v in hyperparameters_to_dict(config.hyperparameters).items() if k != "hidden"})
    for trial in old_trials:
        if trial.state == TrialState.RUNNING:  # the search was stopped in this trial, which is repeated
            # Some of its hyperparameters may have been chosen by then.
            study.enqueue_trial(trial.system_attrs.get("fixed_params", {}) | trial.params)
            study.tell(trial.number, state=TrialState.FAIL)
    return study, sum(trial.state in (TrialState.COMPLETE, TrialState.PRUNED) for trial in old_trials)


def _next_trial(study: Study, config: TrainConfig) -> Trial:
    """The next trial, with its hyperparameters chosen."""
    trial = study.ask()
    config.hyperparameters.sample_hyperparameters(trial)
    return trial


def _train_trial(config: TrainConfig, folder: Path, trial: Trial) -> float | None:
    """Train with the hyperparameters of a trial; returns the score, or None for a pruned trial."""
    import optuna

    output = folder / "trials" / f"{trial.number:03d}"
    trial_config = replace(
        config,
        hyperparameters=replace(config.hyperparameters, **config.hyperparameters.sample_hyperparameters(trial)),
        output=output,
        checkpoints=_EVALUATIONS_PER_TRIAL,
        eval_every=_steps_between_evaluations(config),
    )

    def report(steps: int, scores: HeldOutScores) -> None:
        trial.report(scores.log_posterior_gain, steps)
        if steps < config.steps and trial.should_prune():
            raise optuna.TrialPruned

    try:
        train_or_resume(trial_config, report)
    except optuna.TrialPruned:
        return None
    return final_score(output)


def _steps_between_evaluations(config: TrainConfig) -> int:
    return max(1, config.steps // _EVALUATIONS_PER_TRIAL)


def _print_best_trials(study: Study) -> None:
    """Print the best trials and their hyperparameters."""
    from optuna.trial import TrialState

    complete = study.get_trials(deepcopy=False, states=[TrialState.COMPLETE])
    best = sorted(complete, key=lambda trial: -(trial.value or 0.0))[:_N_TRIALS_SHOWN]
    pruned = len(study.get_trials(deepcopy=False, states=[TrialState.PRUNED]))
    rows = []
    for trial in best:
        values = (f"{v:.3g}" if isinstance(v, float) else str(v) for v in trial.params.values())
        rows.append((str(trial.number), f"{trial.value:.3f}", *values))
    print_texts_and_tables(f"Log posterior gain: {len(complete)} complete trials, {pruned} pruned")
    print_texts_and_tables(format_table(("trial", "nat", *best[0].params), rows))
