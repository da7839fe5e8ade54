"""Inputs that are planned: on the belief, by search, or at known parameters, by gradient."""
