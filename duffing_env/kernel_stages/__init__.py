"""The stages of a compiled environment step: fixed functions, and functions generated from a model's equations."""
