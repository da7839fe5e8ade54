"""The environment as a picture."""
