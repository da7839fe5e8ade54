"""Fuzzing with thousands of bad inputs: ``python -m benchmarks.fuzz``; table in docs/evidence/reliability.md."""
