"""Internals of Numba that this project uses, and the supported versions of Numba.

Raises:
    ImportError: at import, with another version of Numba.
"""

import numba

if not (0, 60) <= tuple(map(int, numba.__version__.split(".")[:2])) < (0, 69):
    raise ImportError(
        f"numba must be at least 0.60 and below 0.69, whose internals duffing-env uses, but is {numba.__version__}; "
        "get one with: pip install 'numba>=0.60,<0.69'",
        name="numba",
    )

from numba.core import cgutils, event
from numba.core.caching import _Cache
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import CompilerBase, CompileResult, DefaultPassBuilder
from numba.core.compiler_machinery import register_pass
from numba.core.extending import _Intrinsic
from numba.core.registry import CPUDispatcher
from numba.core.runtime import rtsys
from numba.core.serialize import dumps
from numba.core.typed_passes import NativeLowering

__all__ = [
    "CPUDispatcher",
    "CompileResult",
    "CompilerBase",
    "DefaultPassBuilder",
    "JITCodeLibrary",
    "NativeLowering",
    "_Cache",
    "_Intrinsic",
    "cgutils",
    "dumps",
    "event",
    "register_pass",
    "rtsys",
]
