"""Checks of a result: what in the records speaks against the rig or the equation."""
