"""The search for oracles, certificates, studies and the paper's experiment. The wheel does not contain this package."""
