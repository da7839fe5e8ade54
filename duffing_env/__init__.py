"""Gymnasium environments whose observation is the posterior of an online system identification.

Importing this package registers the environments of `duffing_env.tracks`.
"""

from duffing_env.tracks import TRACKS, register_tracks

__all__ = ["TRACKS", "register_tracks"]

register_tracks()
