"""Gymnasium environments whose observation is the posterior of an online system identification.

Importing this package registers the environments of `duffing_env.tracks.track_registry`. What else it offers is listed
in ``__init__.pyi`` and imported at first use, because every worker process waits for what is imported here.
"""

import warnings
from pathlib import Path

import lazy_loader

from duffing_env.package_overwrite import overwrite_message

_HOME = Path(__file__).parents[1]
if (_message := overwrite_message("estimator", _HOME)) is not None:
    raise ImportError(_message)
if (_message := overwrite_message("agents", _HOME)) is not None:  # an environment needs no agents
    warnings.warn(_message, stacklevel=2)

from duffing_env.tracks.track_registry import TRACKS, register_tracks  # noqa: E402, F401  only where the estimator is ours

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

register_tracks()
