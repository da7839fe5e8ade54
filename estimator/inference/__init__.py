"""Belief updates: what a sample (u, y) does to a belief, for each recognition factorisation."""

#: Name of a factorisation to the iterations it uses by default: the paper's 10, and 3 where they are scalars.
DEFAULT_ITERATIONS = {"structured": 3, "mean_field": 10}

#: More iterations per sample change nothing that shows.
MAX_ITERATIONS = 100

#: How a step may move a Gaussian belief.
EXPECTATIONS = ("first_order", "sigma_points")
