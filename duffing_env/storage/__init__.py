"""The memory of a batch: its rows by name, its random streams and its recycled arrays."""
