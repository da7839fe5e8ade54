"""Scalar mathematics, written as plain Python functions and translated to LLVM without a detour.

Nearly all that the kernels execute is *straight*: assignments of numbers, one after another, perhaps in a loop over the
lanes of a block. Numba infers types and manages references for whatever Python there is, and spends most of its time on
that. `straight` translates the little that such functions need, from their syntax tree; they are called from code that
Numba compiles, or from Python, like Numba's own.

A straight function may hold

- assignments of names, tuples and entries of blocks ``W[...]`` (flat float64 arrays), and calls for their effect;
- numbers, ``+ - * /``, whole powers up to 8, comparisons, ``a if c else b`` (both sides are evaluated), ``and or not``,
  which give truths; of whole numbers also ``// % << >> & | ^``, where ``//`` and ``%`` are of numbers that are not
  negative, and not by 0;
- ``abs min max``, ``math.floor`` (a float), ``math.sqrt exp log log1p``, ``numpy.sqrt float64 int64 uint64`` and
  ``.view`` of these types, and other straight functions;
- loops ``for name in range(n)`` of at least one turn, which keep nothing but what they write into blocks; and a
  ``return`` at its end.

Multiplications and additions may be fused, as in all of the project's compiled code (`estimator.compilation.simd.NUMBA_OPTIONS`).
"""

from estimator.compilation.scalar_jit.numba_intrinsic import scalar_jit, scalar_jit_from_source

__all__ = ["scalar_jit", "scalar_jit_from_source"]
