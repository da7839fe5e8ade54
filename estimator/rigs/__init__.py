"""Rigs: units, channels, priors of a guess, the TOML files that ship."""
