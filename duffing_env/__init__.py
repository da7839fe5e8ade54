"""Gymnasium environments whose observation is the posterior of an online system identification.

Importing this package registers the environments of `duffing_env.tracks`.
"""

import warnings
from pathlib import Path

from duffing_env.overwritten import overwritten

_HOME = Path(__file__).parents[1]
if (_told := overwritten("estimator", _HOME)) is not None:
    raise ImportError(_told)
if (_told := overwritten("agents", _HOME)) is not None:  # an environment needs no agents
    warnings.warn(_told, stacklevel=2)

from duffing_env.tracks import TRACKS, register_tracks  # noqa: E402  only where the estimator is ours

__all__ = ["TRACKS", "register_tracks"]

register_tracks()
