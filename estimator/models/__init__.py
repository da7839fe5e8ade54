"""Models: what the next output is, given the last ones, the input and the coefficients."""
