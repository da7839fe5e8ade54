"""Experiments on a rig, sample by sample against a clock or block by block (`experiment_run.run_experiment`)."""
