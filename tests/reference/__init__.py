"""What the packages have to compute, in plain NumPy: with matrices, straight from the equations, and nothing shared."""
