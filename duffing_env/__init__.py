"""Gymnasium environments whose observation is the posterior of an online system identification.

Importing this package registers the environments of `duffing_env.tracks.track_registry`.
"""

import warnings
from pathlib import Path

from duffing_env.package_overwrite import overwrite_message

_HOME = Path(__file__).parents[1]
if (_message := overwrite_message("estimator", _HOME)) is not None:
    raise ImportError(_message)
if (_message := overwrite_message("agents", _HOME)) is not None:  # an environment needs no agents
    warnings.warn(_message, stacklevel=2)

from duffing_env.tracks.track_registry import TRACKS, register_tracks  # noqa: E402  only where the estimator is ours

__all__ = ["TRACKS", "register_tracks"]

register_tracks()
