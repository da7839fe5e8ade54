"""Running experiments on a rig: sample by sample against a clock, or block by block (`agents.running.run.run`)."""
