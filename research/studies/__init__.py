"""Studies: the paper's experiment, the Silverbox protocol, trainings that ship."""
