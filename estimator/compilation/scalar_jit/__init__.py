"""`scalar_jit`: branch-free scalar functions in Python, translated directly to LLVM.

The kernels consist mostly of assignments of numbers, in a loop over the lanes of a block. Numba spends most of its
compile time on types and references that these do not need. `scalar_jit` translates such functions from their syntax
tree; compiled functions and Python call them like Numba's own.

A function may have

- assignments of names, tuples and entries of blocks ``W[...]`` (flat float64 arrays), and calls for their effect;
- numbers, ``+ - * /``, integer powers up to 8, comparisons, ``a if c else b`` (both sides are evaluated), ``and or
  not`` with boolean results; of integers also ``// % << >> & | ^``, with ``//`` and ``%`` of non-negative numbers by a
  positive number;
- ``abs min max``, ``math.floor`` (a float), ``math.sqrt exp log log1p``, ``numpy.sqrt float64 int64 uint64`` and
  ``.view`` of these types, and other `scalar_jit` functions;
- loops ``for name in range(n)`` of at least one turn, which write results into blocks only; and a ``return`` at the
  end.

Multiplications and additions may be fused, as in all compiled code (`estimator.compilation.simd.NUMBA_OPTIONS`).
"""

from estimator.compilation.scalar_jit.numba_intrinsic import scalar_jit, scalar_jit_from_source

__all__ = ["scalar_jit", "scalar_jit_from_source"]
