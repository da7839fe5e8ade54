"""Rigs as users have them, simulated by an integrator of the benchmark's own, and `estimator.identify` judged on them.

``python -m benchmarks.rigs --help`` lists the parts. Nothing of the engine's plant is used: an error that estimator and
plant share would not show.
"""
