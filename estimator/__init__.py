"""Online identification of a Duffing oscillator by free energy minimisation.

Useful alone, on any recorded input and output: it knows no environment and no policy.

What it offers is listed in ``__init__.pyi``. Each is imported when it is asked for: the environment needs the beliefs
and the inference, and every worker process waits for what it imports.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
