"""Plants that are not simulated from a model's prior: the Silverbox record and its identified twin."""
