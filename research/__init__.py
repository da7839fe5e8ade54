"""How we know: the search for oracles, certificates, studies and the paper's experiment. Not installed."""
