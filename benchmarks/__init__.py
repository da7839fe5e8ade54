"""Timed benchmarks: `python -m benchmarks`; ``docs/evidence/benchmarks.md`` describes them and has the last results."""
