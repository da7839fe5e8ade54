"""Records read: text tables, MAT files, sampling times, sensor faults."""
