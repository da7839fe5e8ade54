"""The stages of a compiled step: what no model changes, and what is generated from a model."""
