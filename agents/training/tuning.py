"""Search for hyperparameters: Optuna over whole trainings, each judged on held-out systems.

The search folder holds ``study.log`` (Optuna's journal, of JSON lines), ``trials/NUMBER`` (the run folders) and
``best.toml``, which `train.py --settings` reads.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from agents.results import show, table
from agents.training.algorithms import as_written
from agents.training.cluster import spread
from agents.training.config import TrainConfig, claim
from agents.training.heldout import SCORE, score_of
from agents.training.hyperparameters import track_of, write_settings
from agents.training.runs import carry_on
from estimator.extras import need
from estimator.files import held

if TYPE_CHECKING:
    from optuna import Study, Trial

BEST = "best.toml"

_EVALUATIONS = 10  # of each trial; after each it may be given up
_SHOWN = 10


def tune(config: TrainConfig, trials: int, *, on_ray: bool = False) -> Path:
    """Train with many hyperparameters, and write the best.

    The first trial has those of the configuration, the others are chosen by a tree-structured Parzen estimator within
    `AlgorithmSettings.suggest`; a trial whose score falls below the median of the others' at the same samples is given
    up. The score is the mean log posterior gain on held-out systems at the end of a training.

    Args:
        config: of every trial, but for what is searched for.
        trials: how many the search is to have in the end; one that was stopped goes on in the same folder.
        on_ray: whether trials are tasks on a cluster, as many at once as it has processors, see
            `agents.training.cluster`; all its nodes must see the folder. What is chosen then depends on which of them
            are finished first.

    Returns:
        The file of the best hyperparameters.

    Raises:
        ModuleNotFoundError: without Optuna, or Ray where that is asked for.
        ValueError: where the folder holds another search, or another process searches in it.
    """
    need("optuna")
    if on_ray:
        need("ray")
    folder = config.output or Path("runs") / f"tune-{config.algo}-{track_of(config.env).lower()}-{config.seed}"
    folder = folder.resolve()
    claim(folder / "search.json", config)
    with held("output", folder):
        return _search(config, folder, trials, on_ray)


def _search(config: TrainConfig, folder: Path, trials: int, on_ray: bool) -> Path:
    """Search, or go on with it."""
    import optuna
    import optuna.storages.journal

    optuna.logging.set_verbosity(optuna.logging.ERROR)  # it warns of a trial that a signal ended, with a traceback
    storage = optuna.storages.JournalStorage(optuna.storages.journal.JournalFileBackend(str(folder / "study.log")))
    # A folder that was renamed holds the study of its first name.
    name = next(iter(optuna.study.get_all_study_names(storage)), folder.name)
    study = optuna.create_study(storage=storage, study_name=name, load_if_exists=True, direction="maximize")
    begun = study.get_trials(deepcopy=False)
    every = max(1, config.steps // _EVALUATIONS)
    study.sampler = optuna.samplers.TPESampler(
        seed=int(np.random.SeedSequence((config.seed, len(begun))).generate_state(1)[0])
    )
    study.pruner = optuna.pruners.MedianPruner(n_warmup_steps=2 * every)
    if not begun:
        study.enqueue_trial({k: v for k, v in as_written(config.hyperparameters).items() if k != "hidden"})
    state = optuna.trial.TrialState
    for earlier in begun:
        if earlier.state == state.RUNNING:  # the one that the search was stopped in; it is made again
            # It may have been told a part of its hyperparameters by then.
            study.enqueue_trial(earlier.system_attrs.get("fixed_params", {}) | earlier.params)
            study.tell(earlier.number, state=state.FAIL)
    finished = sum(earlier.state in (state.COMPLETE, state.PRUNED) for earlier in begun)

    def objective(trial: Trial) -> float | None:
        """The score; None for a trial that was given up."""
        output = folder / "trials" / f"{trial.number:03d}"
        run = replace(
            config,
            hyperparameters=replace(config.hyperparameters, **config.hyperparameters.suggest(trial)),
            output=output,
            checkpoints=_EVALUATIONS,
            eval_every=every,
        )

        def report(steps: int, found: dict[str, float]) -> None:
            trial.report(found[SCORE], steps)
            if steps < config.steps and trial.should_prune():
                raise optuna.TrialPruned

        try:
            carry_on(run, report)
        except optuna.TrialPruned:
            return None
        return score_of(output)

    def asked() -> Trial:
        """The next trial, whose hyperparameters are chosen here, where all that is known is at hand."""
        trial = study.ask()
        config.hyperparameters.suggest(trial)
        return trial

    left = (asked() for _ in range(trials - finished))
    for trial, score in spread(objective, left) if on_ray else ((trial, objective(trial)) for trial in left):
        study.tell(trial, score, state=state.PRUNED if score is None else state.COMPLETE)
    best = replace(config.hyperparameters, **study.best_params)
    comment = f"{config.algo}, trial {study.best_trial.number} of {folder}: {SCORE} {study.best_value:.3f} nat"
    write_settings(folder / BEST, config.env, best, comment)
    _print_table(study)
    return folder / BEST


def _print_table(study: Study) -> None:
    """The best trials, with what they were given."""
    from optuna.trial import TrialState

    complete = study.get_trials(deepcopy=False, states=[TrialState.COMPLETE])
    best = sorted(complete, key=lambda trial: -(trial.value or 0.0))[:_SHOWN]
    pruned = len(study.get_trials(deepcopy=False, states=[TrialState.PRUNED]))
    rows = []
    for trial in best:
        values = (f"{v:.3g}" if isinstance(v, float) else str(v) for v in trial.params.values())
        rows.append((str(trial.number), f"{trial.value:.3f}", *values))
    show(f"Log posterior gain: {len(complete)} trials to the end, {pruned} given up")
    show(table(("trial", "nat", *best[0].params), rows))
