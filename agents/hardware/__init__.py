"""Running experiments on a rig: sample by sample against a clock, or block by block (`agents.hardware.experiment_run.run_experiment`)."""
