"""Training of policies by PPO, SAC, TD3, TQC or recurrent PPO on any track, in run folders that can be resumed."""

from agents.training.algorithms import (
    ALGORITHMS,
    AlgorithmSettings,
    PPOSettings,
    RecurrentPPOSettings,
    SACSettings,
    TD3Settings,
    TQCSettings,
)
from agents.training.hyperparameter_search import tune_hyperparameters
from agents.training.multi_seed_training import train_seeds
from agents.training.training_config import TrainConfig, TrainingSubject
from agents.training.training_loop import TrainingRun
from agents.training.training_run import resume, train

__all__ = [
    "ALGORITHMS",
    "AlgorithmSettings",
    "PPOSettings",
    "RecurrentPPOSettings",
    "SACSettings",
    "TD3Settings",
    "TQCSettings",
    "TrainConfig",
    "TrainingRun",
    "TrainingSubject",
    "resume",
    "train",
    "train_seeds",
    "tune_hyperparameters",
]
