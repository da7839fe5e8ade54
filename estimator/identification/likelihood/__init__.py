"""The likelihood of records under a model, and its initial states."""
