"""The options of a belief update and their ranges."""

#: Factorisation of the posterior to its default number of iterations per sample; the structured one iterates scalars.
DEFAULT_ITERATIONS = {"structured": 3, "mean_field": 10}

#: Upper limit of the iterations per sample [1].
MAX_ITERATIONS = 100

#: How an update propagates the Gaussian belief: by the derivative at its mean, or by cubature points.
EXPECTATIONS = ("first_order", "sigma_points")
