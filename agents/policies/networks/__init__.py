"""Trained networks: what they see, their shield, how they act and how they are saved."""
