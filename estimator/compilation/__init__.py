"""Compilation: SIMD lanes, branch-free scalar functions, and compiled code on disk."""
