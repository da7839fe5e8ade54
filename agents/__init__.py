"""Who chooses the input: excitation signals, learned policies, training and evaluation; and the commands.

What it offers is listed in ``__init__.pyi``. Each is imported when it is asked for: a command that plays no policy does
not wait for them.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
