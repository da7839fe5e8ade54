"""Bad inputs by the thousand: ``python -m benchmarks.fuzz``. What it finds, and the last table: docs/reliability.md."""
