"""Timed comparisons: `python -m benchmarks`. What is measured, and the last results: ``docs/benchmarks.md``."""
