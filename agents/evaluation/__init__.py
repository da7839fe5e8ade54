"""Policies evaluated: the same systems for all, metrics, oracles, tables, figures and reports."""
