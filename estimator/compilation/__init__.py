"""Compiled code: across SIMD lanes, its own front end, and its cache on disk."""
