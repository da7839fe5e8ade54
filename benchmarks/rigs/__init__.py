"""Benchmarks of `estimator.identify` on rigs of users, simulated by an independent integrator.

``python -m benchmarks.rigs --help`` lists the parts. The simulation uses nothing of the engine, because an error that
estimator and plant shared would not show.
"""
