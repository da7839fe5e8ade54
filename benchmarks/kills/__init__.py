"""Kills: what is left when a command ends at a random moment, and what it is worth."""
