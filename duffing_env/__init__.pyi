# The names of `duffing_env`, for type checkers and for its `__init__.py`, which imports each at first use.
from .batch import spawn_seeds
from .belief_arrays import Beliefs
from .env import DuffingEnv
from .plants.silverbox_record import load_record
from .tracks.external_plant_env import Plant
from .tracks.model_env import ModelEnv
from .tracks.track_registry import TRACKS, register_tracks
from .vector_env import DuffingVectorEnv

__all__ = [
    "TRACKS",
    "Beliefs",
    "DuffingEnv",
    "DuffingVectorEnv",
    "ModelEnv",
    "Plant",
    "load_record",
    "register_tracks",
    "spawn_seeds",
]
