"""Scalar mathematics, compiled to run across lanes.

The equations of this project are written once, as small scalar functions of named quantities. `lanewise` compiles
such a function into a loop over `LANES` independent systems, so that the compiler turns every scalar operation into
a vector operation. All quantities of these systems lie in one flat float64 array, the *block* ``W``: the quantity in
row r of lane j is ``W[r * LANES + j]``. One array with constant offsets is what makes the loops vectorise: with an
array per quantity the compiler cannot rule out that two of them overlap, and falls back to scalar code.
"""

from __future__ import annotations

import hashlib
import inspect
from collections.abc import Callable, Mapping
from functools import cache, partial
from pathlib import Path
from typing import Any

import numba

from estimator.compilation.disk_cache import DiskCache
from estimator.compilation.inner_function_jit import InnerDispatcher
from estimator.compilation.scalar_jit import scalar_jit, scalar_jit_from_source

#: Systems in a block. A multiple of the vector width (8 doubles in AVX-512); 32 lanes of ~120 rows stay within 32 KiB.
LANES = 32

#: No division checks, fused multiply-adds allowed (nothing else: results must not depend on the order of lanes), and no
#: wrapper for callers in C, which has no user and takes time to compile.
NUMBA_OPTIONS: dict[str, Any] = {
    "error_model": "numpy",
    "fastmath": {"contract"},
    "nogil": True,
    "no_cfunc_wrapper": True,
}

#: Compile a function that other compiled functions call.
jit = partial(InnerDispatcher, options=NUMBA_OPTIONS)


def number_rows(*names_in_order: str, first_row: int = 0) -> dict[str, int]:
    """Number the quantities named in ``names_in_order`` (space-separated names), from row ``first_row`` on."""
    names = " ".join(names_in_order).split()
    repeated = sorted({name for name in names if names.count(name) > 1})
    if repeated:
        raise ValueError(f"groups must name every row once, but {repeated} stand there twice; rename them")
    return {name: first_row + i for i, name in enumerate(names)}


def lanewise(
    layout: Mapping[str, int], result_rows: str, uniform: str = "", lanes: int = LANES, single_lane: bool = False
) -> Callable[[Callable[..., Any]], Any]:
    """Compile a straight scalar function (`estimator.compilation.scalar_jit`) to run over all lanes of a block.

    The function's parameters are read from the rows of their names, its results are written to the rows named in
    ``result_rows``. Parameters named in ``uniform`` are the same for all lanes, and become arguments of the loop after
    the block: ``f(W, *uniform)``.

    Args:
        layout: name of a quantity to its row.
        result_rows: the rows that the function returns, in its order, separated by spaces.
        uniform: parameters that are not rows, in the order in which the loop takes them.
        lanes: systems in the block.
        single_lane: for one lane: ``f(W, j, *uniform)``.

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
    """Compile ``f(W, j)``: what a scalar function, which may be anything that Numba compiles, gives in lane j.

    Args:
        layout: name of a quantity to its row; the function's parameters are rows.
        function: to compile.
        lanes: systems in the block.

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
    """Compile an entry point: a function that Python calls, kept on disk (`estimator.compilation.disk_cache`).

    Numba's own cache knows when the file of the function changed, but not the files of the functions it calls; a stale
    kernel would give wrong numbers in silence. So the stamp of ours is a digest of all our sources.

    Args:
        function: to compile.
        variant: see `jit_closure`.
        options: of Numba.
    """
    if function is None:
        return partial(kernel, variant=variant, **options)
    dispatcher = numba.njit(**NUMBA_OPTIONS | options)(_with_variant(function, variant))
    dispatcher._cache = DiskCache(
        function, source_digest(source_folders(function.__code__.co_filename)), has_unique_name=bool(variant)
    )
    return dispatcher


def jit_closure(variant: str) -> Any:
    """Compile a function that is defined within another, and called by other compiled functions.

    Never `jit`: compiled code is joined by names, and code from disk may have been compiled where another function had
    this one's. ``variant`` tells it from the functions that the other defines at other times: the cache on disk, and the
    linker where it joins what several processes compiled, go by names.
    """
    return lambda function: jit(_with_variant(function, variant))


def _with_variant(function: Callable[..., Any], variant: str) -> Callable[..., Any]:
    function.__qualname__ += f"_{variant}" if variant else ""
    return function


#: The packages, each of which may use those before it.
_PACKAGES = ("estimator", "duffing_env", "agents", "research")


def source_folders(file: str) -> tuple[Path, ...]:
    """The folders of all that the code in a file may use: its package, and the packages below."""
    path, project_root = Path(file), Path(__file__).parents[2]
    package = path.relative_to(project_root).parts[0] if path.is_relative_to(project_root) else ""
    if package in _PACKAGES:
        return tuple(project_root / name for name in _PACKAGES[: _PACKAGES.index(package) + 1])
    return (*(project_root / name for name in _PACKAGES), path.parent)


@cache
def source_digest(folders: tuple[Path, ...]) -> str:
    """Of the sources in some folders."""
    digest = hashlib.sha256()
    for folder in folders:
        for path in sorted(folder.rglob("*.py")):
            # What the engine generated stands there too, and follows from the rest.
            if path.parent.name != "__pycache__":
                digest.update(path.read_bytes())
    return digest.hexdigest()


def _define_function(source: str, function: Callable[..., Any], **names: Any) -> Callable[..., Any]:
    """Define the function written in ``source``, filed under the place of ``function``."""
    namespace: dict[str, Any] = dict(names)
    exec(compile(source, function.__code__.co_filename, "exec"), namespace)
    defined: Callable[..., Any] = namespace[function.__name__]
    defined.__module__ = function.__module__
    defined.__doc__ = function.__doc__
    # One scalar function may have several loops, which must not share a name: see `jit_closure`.
    defined.__qualname__ = f"{function.__qualname__}_{hashlib.sha256(source.encode()).hexdigest()[:12]}"
    return defined
