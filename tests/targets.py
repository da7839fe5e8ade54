"""The processor that Numba compiles for, which a setting can make differ from the machine's."""

import platform
from functools import cache

import numba


@cache
def has_fused_multiply_add() -> bool:
    """Whether it is an x86-64 with AVX2 and fused multiply-adds, whose assembly some tests read."""
    if platform.machine().lower() not in ("x86_64", "amd64"):
        return False
    probe = numba.njit("float64(float64, float64, float64)", fastmath={"contract"})(lambda a, b, c: a * b + c)
    return "vfmadd" in next(iter(probe.inspect_asm().values()))
