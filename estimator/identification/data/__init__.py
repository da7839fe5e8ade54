"""Reading of recorded data: text tables, MAT files, sampling times, sensor faults."""
