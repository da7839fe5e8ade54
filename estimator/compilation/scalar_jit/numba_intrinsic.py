"""`scalar_jit` as a Numba intrinsic: the types of a function, and a library for linking."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator
from typing import Any

import numba
from llvmlite import binding, ir
from numba import types

from estimator.compilation.numba_internals import _Intrinsic, cgutils
from estimator.compilation.scalar_jit.function_source import FunctionSource
from estimator.compilation.scalar_jit.llvm_translation import (
    DECLARED_FUNCTIONS,
    ArgumentTypes,
    FunctionTranslation,
    TranslatedFunction,
    flat_types,
    with_vector_metadata,
)

_NUMBA_TYPES = {"double": types.float64, "i1": types.boolean, "i64": types.int64, "word": types.uint64}
_LLVMLITE_TYPES = {"double": ir.DoubleType(), "i1": ir.IntType(1), "i64": ir.IntType(64), "word": ir.IntType(64)}


class ScalarFunction(_Intrinsic):  # type: ignore[misc]
    """A function of `estimator.compilation.scalar_jit`, as an intrinsic of Numba.

    Args:
        function: the Python function.
        text: its source; None to read the file.
    """

    def __init__(self, function: Callable[..., Any], text: str | None = None) -> None:
        self.source = FunctionSource(function, text)
        self._translations: dict[ArgumentTypes, TranslatedFunction] = {}
        self._libraries: dict[ArgumentTypes, _LinkedLibrary] = {}
        arguments = ", ".join(["_typing", *self.source.arguments])
        # Numba binds arguments by the parameter names of the defining function.
        define = eval(f"lambda {arguments}: _define({arguments})", {"_define": self._define})
        super().__init__(function.__name__, define)
        functools.update_wrapper(self, function)
        self.py_func = function
        self._register()

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        """Call the function from Python, in tests and experiments."""
        return self.compiled(*args, **kwargs)

    @functools.cached_property
    def compiled(self) -> Any:
        """The function, compiled by Numba for callers in Python."""
        arguments = ", ".join(self.source.arguments)
        names = {"_function": self, "__name__": self.py_func.__module__}
        return numba.njit(error_model="numpy")(eval(f"lambda {arguments}: _function({arguments})", names))

    def translate(self, argument_types: ArgumentTypes) -> TranslatedFunction:
        """The function for arguments of some types."""
        if argument_types not in self._translations:
            self._translations[argument_types] = FunctionTranslation(self.source).function(argument_types)
        return self._translations[argument_types]

    def _define(self, _typing: Any, *numba_types: Any) -> Any:
        """The signature for arguments of Numba's types, and the generator of a call."""
        argument_types = tuple(self._type_of(types.unliteral(type_)) for type_ in numba_types)

        def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            return self._call(argument_types, context, builder, signature, arguments)

        taken = [numba_types[i] if kind == "ptr" else _numba_type(kind) for i, kind in enumerate(argument_types)]
        return _numba_type(self.translate(argument_types).result)(*taken), generate

    def _call(self, argument_types: ArgumentTypes, context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        """Generate a call."""
        translation = self.translate(argument_types)
        if argument_types not in self._libraries:
            features = context.codegen().magic_tuple()[-1]
            self._libraries[argument_types] = _LinkedLibrary(translation, builder.module, "+avx512f" in features)
        context.active_code_library.add_linking_library(self._libraries[argument_types])
        given = [
            value
            for kind, type_, argument in zip(argument_types, signature.args, arguments, strict=True)
            for value in _unpack(context, builder, kind, type_, argument)
        ]
        results = [_LLVMLITE_TYPES[kind] for kind in flat_types(translation.result)]
        returned = ir.LiteralStructType(results) if results else ir.VoidType()
        type_ = ir.FunctionType(returned, [value.type for value in given])
        returned_struct = builder.call(cgutils.get_or_insert_function(builder.module, type_, translation.name), given)
        if not results:
            return context.get_dummy_value()
        values = (builder.extract_value(returned_struct, i) for i in range(len(results)))
        return _pack(context, builder, signature.return_type, translation.result, values)

    def _type_of(self, type_: Any) -> Any:
        """The LLVM type of Numba's type.

        Raises:
            TypeError: for other types than numbers, tuples and flat arrays.
        """
        if isinstance(type_, types.Array):
            if (type_.dtype, type_.ndim, type_.layout) != (types.float64, 1, "C"):
                raise TypeError(f"{self._name} needs flat, contiguous float64 arrays, but is given {type_}; convert it")
            return "ptr"
        if isinstance(type_, types.Tuple | types.UniTuple):
            return tuple(map(self._type_of, type_.types))
        if isinstance(type_, types.Float):
            return "double"
        if isinstance(type_, types.Boolean):
            return "i1"
        if isinstance(type_, types.Integer):
            return "word" if type_ == types.uint64 else "i64"
        raise TypeError(f"{self._name} takes numbers, tuples of them and flat arrays, but is given {type_}; convert it")


def scalar_jit(function: Callable[..., Any]) -> Any:
    """Translate a scalar function: see `estimator.compilation.scalar_jit`."""
    return ScalarFunction(function)


def scalar_jit_from_source(source: str) -> Callable[[Callable[..., Any]], Any]:
    """As `scalar_jit`, for functions defined by executing ``source``."""
    return lambda function: ScalarFunction(function, source)


class _LinkedLibrary:
    """A translated function for linking, with the data layout of the calling module.

    Args:
        translation: the translated function.
        calling_module: the calling module.
        has_avx512: whether the processor has AVX-512.
    """

    def __init__(self, translation: TranslatedFunction, calling_module: Any, has_avx512: bool) -> None:
        head = f'target datalayout = "{calling_module.data_layout}"\ntarget triple = "{calling_module.triple}"\n'
        declared = "".join(f"declare double @{name}(double)\n" for name in DECLARED_FUNCTIONS)
        definitions = with_vector_metadata("".join(translation.definitions.values()), has_avx512)
        self._module = binding.parse_assembly(head + declared + definitions)
        self._reload_init: set[str] = set()

    def _ensure_finalized(self) -> None:
        """Nothing to finalise."""

    def _get_module_for_linking(self) -> binding.ModuleRef:
        return self._module


def _numba_type(flat_or_nested: Any) -> Any:
    """Numba's type of an LLVM type, or of nested ones."""
    if flat_or_nested is None:
        return types.none
    return (
        types.BaseTuple.from_types([_numba_type(kind) for kind in flat_or_nested])
        if isinstance(flat_or_nested, tuple)
        else _NUMBA_TYPES[flat_or_nested]
    )


def _unpack(context: Any, builder: Any, kind: Any, type_: Any, value: Any) -> Iterator[Any]:
    """The numbers in a value of Numba's; of an array, its address."""
    if kind == "ptr":
        yield context.make_array(type_)(context, builder, value).data
    elif isinstance(kind, tuple):
        for i, part in enumerate(kind):
            yield from _unpack(context, builder, part, type_.types[i], builder.extract_value(value, i))
    else:
        yield value


def _pack(context: Any, builder: Any, type_: Any, kinds: Any, values: Iterator[Any]) -> Any:
    """A value of Numba's from the next numbers."""
    if not isinstance(kinds, tuple):
        return next(values)
    parts = [_pack(context, builder, type_.types[i], kind, values) for i, kind in enumerate(kinds)]
    return context.make_tuple(builder, type_, parts)
