"""Search for hyperparameters: Optuna over whole trainings, each judged on held-out systems.

The search folder holds ``study.log`` (Optuna's journal, of JSON lines), ``trials/NUMBER`` (the run folders) and
``best.toml``, which `train.py --settings` reads.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from agents.console_output import format_table, print_texts_and_tables
from agents.training.algorithms import hyperparameters_to_dict
from agents.training.heldout_evaluation import HELDOUT_SCORE, final_score
from agents.training.hyperparameters import track_name, write_hyperparameters
from agents.training.ray_tasks import run_on_ray
from agents.training.training_config import TrainConfig, claim_run_folder
from agents.training.training_run import train_or_resume
from estimator.support.file_io import locked_folder
from estimator.support.optional_dependencies import require_packages

if TYPE_CHECKING:
    from optuna import Study, Trial

BEST_HYPERPARAMETERS_FILE = "best.toml"

_EVALUATIONS_PER_TRIAL = 10  # of each trial; after each it may be given up
_N_TRIALS_SHOWN = 10


def tune_hyperparameters(config: TrainConfig, trials: int, *, on_ray: bool = False) -> Path:
    """Train with many hyperparameters, and write the best.

    The first trial has those of the configuration, the others are chosen by a tree-structured Parzen estimator within
    `AlgorithmSettings.sample_hyperparameters`; a trial whose score falls below the median of the others' at the same samples is given
    up. The score is the mean log posterior gain on held-out systems at the end of a training.

    Args:
        config: of every trial, but for what is searched for.
        trials: how many the search is to have in the end; one that was stopped goes on in the same folder.
        on_ray: whether trials are tasks on a cluster, as many at once as it has processors, see
            `agents.training.ray_tasks`; all its nodes must see the folder. What is chosen then depends on which of them
            are finished first.

    Returns:
        The file of the best hyperparameters.

    Raises:
        ModuleNotFoundError: without Optuna, or Ray where that is asked for.
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
    """Search, or go on with it."""
    import optuna
    import optuna.storages.journal

    optuna.logging.set_verbosity(optuna.logging.ERROR)  # it warns of a trial that a signal ended, with a traceback
    storage = optuna.storages.JournalStorage(optuna.storages.journal.JournalFileBackend(str(folder / "study.log")))
    # A folder that was renamed holds the study of its first name.
    name = next(iter(optuna.study.get_all_study_names(storage)), folder.name)
    study = optuna.create_study(storage=storage, study_name=name, load_if_exists=True, direction="maximize")
    old_trials = study.get_trials(deepcopy=False)
    every = max(1, config.steps // _EVALUATIONS_PER_TRIAL)
    study.sampler = optuna.samplers.TPESampler(
        seed=int(np.random.SeedSequence((config.seed, len(old_trials))).generate_state(1)[0])
    )
    study.pruner = optuna.pruners.MedianPruner(n_warmup_steps=2 * every)
    if not old_trials:
        study.enqueue_trial({k: v for k, v in hyperparameters_to_dict(config.hyperparameters).items() if k != "hidden"})
    state = optuna.trial.TrialState
    for old_trial in old_trials:
        if old_trial.state == state.RUNNING:  # the one that the search was stopped in; it is made again
            # It may have been told a part of its hyperparameters by then.
            study.enqueue_trial(old_trial.system_attrs.get("fixed_params", {}) | old_trial.params)
            study.tell(old_trial.number, state=state.FAIL)
    finished = sum(earlier.state in (state.COMPLETE, state.PRUNED) for earlier in old_trials)

    def objective(trial: Trial) -> float | None:
        """The score; None for a trial that was given up."""
        output = folder / "trials" / f"{trial.number:03d}"
        trial_config = replace(
            config,
            hyperparameters=replace(config.hyperparameters, **config.hyperparameters.sample_hyperparameters(trial)),
            output=output,
            checkpoints=_EVALUATIONS_PER_TRIAL,
            eval_every=every,
        )

        def report(steps: int, scores: dict[str, float]) -> None:
            trial.report(scores[HELDOUT_SCORE], steps)
            if steps < config.steps and trial.should_prune():
                raise optuna.TrialPruned

        try:
            train_or_resume(trial_config, report)
        except optuna.TrialPruned:
            return None
        return final_score(output)

    def next_trial() -> Trial:
        """The next trial, whose hyperparameters are chosen here, where all that is known is at hand."""
        trial = study.ask()
        config.hyperparameters.sample_hyperparameters(trial)
        return trial

    remaining_trials = (next_trial() for _ in range(trials - finished))
    for trial, score in (
        run_on_ray(objective, remaining_trials) if on_ray else ((trial, objective(trial)) for trial in remaining_trials)
    ):
        study.tell(trial, score, state=state.PRUNED if score is None else state.COMPLETE)
    best = replace(config.hyperparameters, **study.best_params)
    comment = f"{config.algo}, trial {study.best_trial.number} of {folder}: {HELDOUT_SCORE} {study.best_value:.3f} nat"
    write_hyperparameters(folder / BEST_HYPERPARAMETERS_FILE, config.env, best, comment)
    _print_best_trials(study)
    return folder / BEST_HYPERPARAMETERS_FILE


def _print_best_trials(study: Study) -> None:
    """The best trials, with what they were given."""
    from optuna.trial import TrialState

    complete = study.get_trials(deepcopy=False, states=[TrialState.COMPLETE])
    best = sorted(complete, key=lambda trial: -(trial.value or 0.0))[:_N_TRIALS_SHOWN]
    pruned = len(study.get_trials(deepcopy=False, states=[TrialState.PRUNED]))
    rows = []
    for trial in best:
        values = (f"{v:.3g}" if isinstance(v, float) else str(v) for v in trial.params.values())
        rows.append((str(trial.number), f"{trial.value:.3f}", *values))
    print_texts_and_tables(f"Log posterior gain: {len(complete)} trials to the end, {pruned} given up")
    print_texts_and_tables(format_table(("trial", "nat", *best[0].params), rows))
