"""Online identification of nonlinear systems by free energy minimisation.

The package works on any recorded input and output, without environments and policies.

``__init__.pyi`` lists its names. Each is imported on first use, which keeps the start of worker processes short.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
