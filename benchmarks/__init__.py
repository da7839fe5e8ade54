"""Timed benchmarks: `python -m benchmarks`; ``docs/benchmarks.md`` describes them and has the last results."""
