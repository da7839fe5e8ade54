"""The engine: from a model's declaration to compiled kernels.

`derive` does the calculus, `algebra` and `path` the filter, `emit` writes the source, `cache` keeps it, and `tasks` is
what the rest of the project calls. SymPy is imported only where a source is generated for the first time.
"""
