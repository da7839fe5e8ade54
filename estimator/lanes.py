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

from estimator.compiled import Compiled
from estimator.inner import Inner
from estimator.straight import straight, straight_within

#: Systems in a block. A multiple of the vector width (8 doubles in AVX-512); 32 lanes of ~120 rows stay within 32 KiB.
LANES = 32

#: No division checks, fused multiply-adds allowed (nothing else: results must not depend on the order of lanes), and no
#: wrapper for callers in C, which has no user and takes time to compile.
OPTIONS: dict[str, Any] = {"error_model": "numpy", "fastmath": {"contract"}, "nogil": True, "no_cfunc_wrapper": True}

#: Compile a function that other compiled functions call.
jit = partial(Inner, options=OPTIONS)


def rows(*groups: str, start: int = 0) -> dict[str, int]:
    """Number the quantities named in ``groups`` (space-separated names), from row ``start`` on."""
    names = " ".join(groups).split()
    repeated = sorted({name for name in names if names.count(name) > 1})
    if repeated:
        raise ValueError(f"groups must name every row once, but {repeated} stand there twice; rename them")
    return {name: start + i for i, name in enumerate(names)}


def lanewise(
    layout: Mapping[str, int], outputs: str, uniform: str = "", lanes: int = LANES, one: bool = False
) -> Callable[[Callable[..., Any]], Any]:
    """Compile a straight scalar function (`estimator.straight`) to run over all lanes of a block.

    The function's parameters are read from the rows of their names, its results are written to the rows named in
    ``outputs``. Parameters named in ``uniform`` are the same for all lanes, and become arguments of the loop after
    the block: ``f(W, *uniform)``.

    Args:
        layout: name of a quantity to its row.
        outputs: the rows that the function returns, in its order, separated by spaces.
        uniform: parameters that are not rows, in the order in which the loop takes them.
        lanes: systems in the block.
        one: for one lane: ``f(W, j, *uniform)``.

    Raises:
        ValueError: for a parameter that is neither a row nor uniform, or both.
    """

    def decorate(function: Callable[..., Any]) -> Any:
        arguments = _places(function, layout, uniform, lanes)
        targets = ", ".join(f"W[{layout[n] * lanes} + j]" for n in outputs.split())
        head = f"def {function.__name__}({', '.join(['W', *(['j'] if one else []), *uniform.split()])}):\n"
        loop = "" if one else f"    for j in range({lanes}):\n    "
        source = f"{head}{loop}    {targets} = scalar({arguments})\n"
        return straight_within(source)(_define(source, function, scalar=straight(function)))

    return decorate


def of_lane(layout: Mapping[str, int], function: Callable[..., Any], lanes: int = LANES) -> Any:
    """Compile ``f(W, j)``: what a scalar function, which may be anything that Numba compiles, gives in lane j.

    Args:
        layout: name of a quantity to its row; the function's parameters are rows.
        function: to compile.
        lanes: systems in the block.

    Raises:
        ValueError: for a parameter that is not a row.
    """
    source = f"def {function.__name__}(W, j):\n    return scalar({_places(function, layout, '', lanes)})\n"
    return jit(_define(source, function, scalar=jit(function)))


def _places(function: Callable[..., Any], layout: Mapping[str, int], uniform: str, lanes: int) -> str:
    """The arguments of a scalar function, as source text."""
    names = list(inspect.signature(function).parameters)
    for name in names:
        if (name in layout) == (name in uniform.split()):
            raise ValueError(f"{name} of {function.__name__} must be a row or uniform, and not both; rename it")
    return ", ".join(f"W[{layout[n] * lanes} + j]" if n in layout else n for n in names)


def kernel(function: Callable[..., Any] | None = None, *, kind: str = "", **options: Any) -> Any:
    """Compile an entry point: a function that Python calls, kept on disk (`estimator.compiled`).

    Numba's own cache knows when the file of the function changed, but not the files of the functions it calls; a stale
    kernel would give wrong numbers in silence. So the stamp of ours is a digest of all our sources.

    Args:
        function: to compile.
        kind: see `part`.
        options: of Numba.
    """
    if function is None:
        return partial(kernel, kind=kind, **options)
    dispatcher = numba.njit(**OPTIONS | options)(_renamed(function, kind))
    dispatcher._cache = Compiled(function, source_digest(sources_of(function.__code__.co_filename)), named=bool(kind))
    return dispatcher


def part(kind: str) -> Any:
    """Compile a function that is defined within another, and called by other compiled functions.

    Never `jit`: compiled code is joined by names, and code from disk may have been compiled where another function had
    this one's. ``kind`` tells it from the functions that the other defines at other times: the cache on disk, and the
    linker where it joins what several processes compiled, go by names.
    """
    return lambda function: jit(_renamed(function, kind))


def _renamed(function: Callable[..., Any], kind: str) -> Callable[..., Any]:
    function.__qualname__ += f"_{kind}" if kind else ""
    return function


#: The packages, each of which may use those before it.
_FLOORS = ("estimator", "duffing_env", "agents")


def sources_of(file: str) -> tuple[Path, ...]:
    """The folders of all that the code in a file may use: its package, and the packages below."""
    path, root = Path(file), Path(__file__).parents[1]
    package = path.relative_to(root).parts[0] if path.is_relative_to(root) else ""
    if package in _FLOORS:
        return tuple(root / name for name in _FLOORS[: _FLOORS.index(package) + 1])
    return (*(root / name for name in _FLOORS), path.parent)


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


def _define(source: str, function: Callable[..., Any], **names: Any) -> Callable[..., Any]:
    """Define the function written in ``source``, filed under the place of ``function``."""
    namespace: dict[str, Any] = dict(names)
    exec(compile(source, function.__code__.co_filename, "exec"), namespace)
    defined: Callable[..., Any] = namespace[function.__name__]
    defined.__module__ = function.__module__
    defined.__doc__ = function.__doc__
    # One scalar function may have several loops, which must not share a name: see `part`.
    defined.__qualname__ = f"{function.__qualname__}_{hashlib.sha256(source.encode()).hexdigest()[:12]}"
    return defined
