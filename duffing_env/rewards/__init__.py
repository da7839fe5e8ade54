"""The rewards, one module each, and their registry."""
