"""Fuzzing with thousands of bad inputs: ``python -m benchmarks.fuzz``; docs/reliability.md has the last table."""
