"""The engine: compiled filters, predictions and gradients, generated from the equations of a model.

`symbolic` differentiates the model, `gaussian_update` and `linearised_filter` write the filter, `printer_numba` prints
its source, `source_cache` keeps it on disk, and `kernels` compiles it. SymPy is imported only when source is generated.
"""
