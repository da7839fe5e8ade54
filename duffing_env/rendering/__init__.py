"""Rendering of an environment's episode as a picture."""
