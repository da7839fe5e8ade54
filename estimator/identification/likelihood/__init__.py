"""The likelihood of records under a model, its most probable coefficients, and the initial states of the records."""
