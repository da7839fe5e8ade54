"""How an input is interpolated between two samples."""

#: Interpolation of the input between two samples to the degree of its polynomial over a sample.
INTERPOLATION_DEGREES = {"zero_order": 0, "linear": 1, "look_ahead": 5, "spline": 5}

#: Interpolations that need no input after the sample, with the degree of their polynomials.
CAUSAL_INTERPOLATION_DEGREES = {name: degree for name, degree in INTERPOLATION_DEGREES.items() if degree < 2}
