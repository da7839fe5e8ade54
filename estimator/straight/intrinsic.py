"""What Numba is told of a straight function: its types, and a library to link."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator
from typing import Any

import numba
from llvmlite import binding, ir
from numba import types

from estimator.numba_internals import _Intrinsic, cgutils
from estimator.straight.translation import EXTERNAL, Kinds, Source, Translated, Translation, leaves, vectorised

_TYPES = {"double": types.float64, "i1": types.boolean, "i64": types.int64, "word": types.uint64}
_LLVM = {"double": ir.DoubleType(), "i1": ir.IntType(1), "i64": ir.IntType(64), "word": ir.IntType(64)}


class Straight(_Intrinsic):  # type: ignore[misc]
    """A straight function: see `estimator.straight`. Numba takes it for an intrinsic of its own.

    Args:
        function: as Python defined it.
        text: that was executed to define it; None where its file holds it.
    """

    def __init__(self, function: Callable[..., Any], text: str | None = None) -> None:
        self.source = Source(function, text)
        self._translated: dict[Kinds, Translated] = {}
        self._libraries: dict[Kinds, _Library] = {}
        arguments = ", ".join(["_typing", *self.source.arguments])
        # Numba binds arguments by the names of what defines an intrinsic.
        define = eval(f"lambda {arguments}: _define({arguments})", {"_define": self._define})
        super().__init__(function.__name__, define)
        functools.update_wrapper(self, function)
        self.py_func = function
        self._register()

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        """From Python, for what is tried out or tested."""
        return self.compiled(*args, **kwargs)

    @functools.cached_property
    def compiled(self) -> Any:
        """The function on its own, as Numba compiles it for callers in Python."""
        arguments = ", ".join(self.source.arguments)
        names = {"_function": self, "__name__": self.py_func.__module__}
        return numba.njit(error_model="numpy")(eval(f"lambda {arguments}: _function({arguments})", names))

    def translated(self, kinds: Kinds) -> Translated:
        """The function for arguments of some kinds."""
        if kinds not in self._translated:
            self._translated[kinds] = Translation(self.source).function(kinds)
        return self._translated[kinds]

    def _define(self, _typing: Any, *given: Any) -> Any:
        """The signature for arguments of Numba's types, and what generates the call."""
        kinds = tuple(self._kind(types.unliteral(type_)) for type_ in given)

        def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            return self._call(kinds, context, builder, signature, arguments)

        taken = [given[i] if kind == "ptr" else _type(kind) for i, kind in enumerate(kinds)]
        return _type(self.translated(kinds).result)(*taken), generate

    def _call(self, kinds: Kinds, context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        """Generate a call."""
        text = self.translated(kinds)
        if kinds not in self._libraries:
            features = context.codegen().magic_tuple()[-1]
            self._libraries[kinds] = _Library(text, builder.module, "+avx512f" in features)
        context.active_code_library.add_linking_library(self._libraries[kinds])
        given = [
            value
            for kind, type_, argument in zip(kinds, signature.args, arguments, strict=True)
            for value in _unpacked(context, builder, kind, type_, argument)
        ]
        results = [_LLVM[kind] for kind in leaves(text.result)]
        returned = ir.LiteralStructType(results) if results else ir.VoidType()
        type_ = ir.FunctionType(returned, [value.type for value in given])
        answer = builder.call(cgutils.get_or_insert_function(builder.module, type_, text.name), given)
        if not results:
            return context.get_dummy_value()
        values = (builder.extract_value(answer, i) for i in range(len(results)))
        return _packed(context, builder, signature.return_type, text.result, values)

    def _kind(self, type_: Any) -> Any:
        """The kind of Numba's type.

        Raises:
            TypeError: for another type than numbers, tuples and flat arrays.
        """
        if isinstance(type_, types.Array):
            if (type_.dtype, type_.ndim, type_.layout) != (types.float64, 1, "C"):
                raise TypeError(f"{self._name} needs flat, contiguous float64 arrays, but is given {type_}")
            return "ptr"
        if isinstance(type_, types.Tuple | types.UniTuple):
            return tuple(map(self._kind, type_.types))
        if isinstance(type_, types.Float):
            return "double"
        if isinstance(type_, types.Boolean):
            return "i1"
        if isinstance(type_, types.Integer):
            return "word" if type_ == types.uint64 else "i64"
        raise TypeError(f"{self._name} takes numbers, tuples of them and flat arrays, but is given {type_}")


def straight(function: Callable[..., Any]) -> Any:
    """Translate a scalar function: see `estimator.straight`."""
    return Straight(function)


def straight_within(source: str) -> Callable[[Callable[..., Any]], Any]:
    """As `straight`, for functions of a source that is executed, and need not be in a file."""
    return lambda function: Straight(function, source)


class _Library:
    """A translated function as Numba links it: with the data layout of the module that calls it.

    Args:
        text: of the function.
        caller: the module.
        is_wide: whether the processor has AVX-512.
    """

    def __init__(self, text: Translated, caller: Any, is_wide: bool) -> None:
        head = f'target datalayout = "{caller.data_layout}"\ntarget triple = "{caller.triple}"\n'
        declared = "".join(f"declare double @{name}(double)\n" for name in EXTERNAL)
        definitions = vectorised("".join(text.definitions.values()), is_wide)
        self._module = binding.parse_assembly(head + declared + definitions)
        self._reload_init: set[str] = set()

    def _ensure_finalized(self) -> None:
        """There is nothing to finish."""

    def _get_module_for_linking(self) -> binding.ModuleRef:
        return self._module


def _type(kinds: Any) -> Any:
    """Numba's type of kinds."""
    if kinds is None:
        return types.none
    return types.BaseTuple.from_types([_type(kind) for kind in kinds]) if isinstance(kinds, tuple) else _TYPES[kinds]


def _unpacked(context: Any, builder: Any, kind: Any, type_: Any, value: Any) -> Iterator[Any]:
    """The numbers in a value of Numba's; of an array, where it lies."""
    if kind == "ptr":
        yield context.make_array(type_)(context, builder, value).data
    elif isinstance(kind, tuple):
        for i, part in enumerate(kind):
            yield from _unpacked(context, builder, part, type_.types[i], builder.extract_value(value, i))
    else:
        yield value


def _packed(context: Any, builder: Any, type_: Any, kinds: Any, values: Iterator[Any]) -> Any:
    """The next numbers as a value of Numba's."""
    if not isinstance(kinds, tuple):
        return next(values)
    parts = [_packed(context, builder, type_.types[i], kind, values) for i, kind in enumerate(kinds)]
    return context.make_tuple(builder, type_, parts)
