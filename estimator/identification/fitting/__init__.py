"""Fitting of coefficients and noises: starting points, searches, profile likelihoods, and the posterior belief."""
