"""Reference implementations in plain NumPy, with matrices, directly from the equations."""
