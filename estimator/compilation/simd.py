"""Compiling scalar functions across SIMD lanes, and the project's own variants of Numba's jit.

The equations are written once, as small scalar functions of named quantities. `lanewise` compiles such a function into
a loop over `LANES` independent systems, and the compiler turns every scalar operation into a vector operation. All
quantities of these systems lie in one flat float64 array, the *block* ``W``: the quantity in row r of lane j is
``W[r * LANES + j]``. The loops vectorise because of the constant offsets into one array: of separate arrays the
compiler cannot rule out that they overlap.
"""

from __future__ import annotations

import hashlib
import inspect
from collections.abc import Callable, Mapping
from functools import cache, partial
from pathlib import Path
from typing import Any

import numba

from estimator.compilation.fault_tolerant_cache import DiskCache
from estimator.compilation.inner_function_jit import InnerDispatcher
from estimator.compilation.scalar_jit import scalar_jit, scalar_jit_from_source

#: Number of systems in a block: a multiple of the AVX-512 vector of 8 doubles, with some 120 rows in 32 KiB of cache.
LANES = 32

#: Options of Numba: no checks of divisions, fused multiply-adds but no other reordering (results must not depend on the
#: order of lanes), and no wrapper for callers in C, which has no user.
NUMBA_OPTIONS: dict[str, Any] = {
    "error_model": "numpy",
    "fastmath": {"contract"},
    "nogil": True,
    "no_cfunc_wrapper": True,
}

#: Compile a function for callers in other compiled functions.
jit = partial(InnerDispatcher, options=NUMBA_OPTIONS)


def number_rows(*names_in_order: str, first_row: int = 0) -> dict[str, int]:
    """Number quantities, given as space-separated names, from row ``first_row`` on.

    Raises:
        ValueError: for a name that occurs twice.
    """
    names = " ".join(names_in_order).split()
    repeated = sorted({name for name in names if names.count(name) > 1})
    if repeated:
        raise ValueError(f"names_in_order must have every row once, but has {repeated} twice; rename them")
    return {name: first_row + i for i, name in enumerate(names)}


def lanewise(
    layout: Mapping[str, int], result_rows: str, uniform: str = "", lanes: int = LANES, single_lane: bool = False
) -> Callable[[Callable[..., Any]], Any]:
    """Compile a branch-free scalar function (`estimator.compilation.scalar_jit`) to run over all lanes of a block.

    The loop reads each parameter from the row of its name, and writes the results to ``result_rows``. Parameters in
    ``uniform`` are the same for all lanes, and become arguments of the loop: ``f(W, *uniform)``.

    Args:
        layout: name of a quantity to its row.
        result_rows: names of the rows of the results, in order, separated by spaces.
        uniform: names of the parameters that are not rows, in the order of the loop's arguments.
        lanes: lanes of the block.
        single_lane: compile ``f(W, j, *uniform)`` for one lane j.

    Raises:
        ValueError: for a parameter that is neither a row nor uniform, or both.
    """

    def decorate(function: Callable[..., Any]) -> Any:
        arguments = _argument_text(function, layout, uniform, lanes)
        assigned = ", ".join(f"W[{layout[n] * lanes} + j]" for n in result_rows.split())
        head = f"def {function.__name__}({', '.join(['W', *(['j'] if single_lane else []), *uniform.split()])}):\n"
        loop = "" if single_lane else f"    for j in range({lanes}):\n    "
        source = f"{head}{loop}    {assigned} = scalar({arguments})\n"
        return scalar_jit_from_source(source)(_define_function(source, function, scalar=scalar_jit(function)))

    return decorate


def jit_single_lane(layout: Mapping[str, int], function: Callable[..., Any], lanes: int = LANES) -> Any:
    """Compile ``f(W, j)``: the result of a scalar function, with any code that Numba compiles, in lane j.

    Args:
        layout: name of a quantity to its row; every parameter is a row.
        function: the scalar function.
        lanes: lanes of the block.

    Raises:
        ValueError: for a parameter that is not a row.
    """
    source = f"def {function.__name__}(W, j):\n    return scalar({_argument_text(function, layout, '', lanes)})\n"
    return jit(_define_function(source, function, scalar=jit(function)))


def _argument_text(function: Callable[..., Any], layout: Mapping[str, int], uniform: str, lanes: int) -> str:
    """The arguments of a scalar function, as source text."""
    names = list(inspect.signature(function).parameters)
    for name in names:
        if (name in layout) == (name in uniform.split()):
            raise ValueError(f"{name} of {function.__name__} must be a row or uniform, and not both; rename it")
    return ", ".join(f"W[{layout[n] * lanes} + j]" if n in layout else n for n in names)


def kernel(function: Callable[..., Any] | None = None, *, variant: str = "", **options: Any) -> Any:
    """Compile an entry point, which Python calls, and cache it (`estimator.compilation.fault_tolerant_cache`).

    Numba's own cache misses changes in the files of called functions, and a stale kernel would give wrong numbers in
    silence. So this cache has a digest of all sources.

    Args:
        function: the function.
        variant: see `jit_closure`.
        options: further options of Numba.
    """
    if function is None:
        return partial(kernel, variant=variant, **options)
    dispatcher = numba.njit(**NUMBA_OPTIONS | options)(_with_variant(function, variant))
    dispatcher._cache = DiskCache(
        function, source_digest(source_folders(function.__code__.co_filename)), has_unique_name=bool(variant)
    )
    return dispatcher


def jit_closure(variant: str) -> Any:
    """Compile a function that is defined within another, for callers in compiled functions.

    `jit` would be wrong: the linker and the disk cache identify functions by name, and all closures of one definition
    have the same. ``variant`` is appended to the name, and must differ between closures with different values.
    """
    return lambda function: jit(_with_variant(function, variant))


def _with_variant(function: Callable[..., Any], variant: str) -> Callable[..., Any]:
    function.__qualname__ += f"_{variant}" if variant else ""
    return function


#: The packages; each imports only packages before it.
_PACKAGES = ("estimator", "duffing_env", "agents", "research")


def source_folders(file: str) -> tuple[Path, ...]:
    """Folders of all code that a file may import: its package, and the packages below."""
    path, project_root = Path(file), Path(__file__).parents[2]
    package = path.relative_to(project_root).parts[0] if path.is_relative_to(project_root) else ""
    if package in _PACKAGES:
        return tuple(project_root / name for name in _PACKAGES[: _PACKAGES.index(package) + 1])
    return (*(project_root / name for name in _PACKAGES), path.parent)


@cache
def source_digest(folders: tuple[Path, ...]) -> str:
    """Digest of the sources in some folders."""
    digest = hashlib.sha256()
    for folder in folders:
        for path in sorted(folder.rglob("*.py")):
            # Generated source is there too, and is a function of the rest.
            if path.parent.name != "__pycache__":
                digest.update(path.read_bytes())
    return digest.hexdigest()


def _define_function(source: str, function: Callable[..., Any], **names: Any) -> Callable[..., Any]:
    """Define the function in ``source``, with the file and module of ``function``."""
    namespace: dict[str, Any] = dict(names)
    exec(compile(source, function.__code__.co_filename, "exec"), namespace)
    defined: Callable[..., Any] = namespace[function.__name__]
    defined.__module__ = function.__module__
    defined.__doc__ = function.__doc__
    # Several loops of one scalar function need different names: see `jit_closure`.
    defined.__qualname__ = f"{function.__qualname__}_{hashlib.sha256(source.encode()).hexdigest()[:12]}"
    return defined
