"""Training: any algorithm on any registered track, into a run folder that can rebuild itself and be resumed."""

from agents.training.algorithms import (
    ALGORITHMS,
    AlgorithmSettings,
    PPOSettings,
    RecurrentPPOSettings,
    SACSettings,
    TD3Settings,
    TQCSettings,
)
from agents.training.config import Subject, TrainConfig
from agents.training.runs import Run, resume, train
from agents.training.seeds import train_seeds
from agents.training.tuning import tune

__all__ = [
    "ALGORITHMS",
    "AlgorithmSettings",
    "PPOSettings",
    "RecurrentPPOSettings",
    "Run",
    "SACSettings",
    "Subject",
    "TD3Settings",
    "TQCSettings",
    "TrainConfig",
    "resume",
    "train",
    "train_seeds",
    "tune",
]
