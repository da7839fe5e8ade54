"""Policies that choose the input, their training and evaluation, experiments on hardware, and the commands.

The public names are in ``__init__.pyi``. Each is imported at its first use, so that commands without policies start
fast.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
