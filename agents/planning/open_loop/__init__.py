"""Blocks of inputs that are fixed before their outputs are seen."""
