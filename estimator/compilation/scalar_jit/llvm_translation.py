"""Translation of a function's syntax tree to LLVM text."""

from __future__ import annotations

import ast
import hashlib
import math
import re
import textwrap
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import reduce
from typing import Any, NamedTuple

import numpy as np

from estimator.compilation.scalar_jit.function_source import FunctionSource
from estimator.compilation.scalar_jit.llvm_arithmetic import (
    FMA_FLAG,
    LLVM_TYPES,
    LlvmArithmetic,
    Scalar,
    is_number,
    is_tuple,
)

#: LLVM types of arguments or results (`estimator.compilation.scalar_jit.llvm_arithmetic.Scalar`), and tuples of them.
ArgumentTypes = tuple[Any, ...]


class TranslatedFunction(NamedTuple):
    """A function translated for arguments of certain types.

    Attributes:
        name: unique name, with a digest.
        definitions: name to LLVM text, of the function and the functions it calls.
        result: types of its results; None for no result.
    """

    name: str
    definitions: Mapping[str, str]
    result: Any


#: Functions of one number to their names in LLVM or the C library.
_FUNCTIONS: dict[Callable[..., Any], str] = {
    math.sqrt: "llvm.sqrt.f64", np.sqrt: "llvm.sqrt.f64", math.floor: "llvm.floor.f64", abs: "llvm.fabs.f64",
    math.exp: "llvm.exp.f64", math.log: "llvm.log.f64", math.log1p: "log1p",
}  # fmt: skip

#: External functions that every module declares.
DECLARED_FUNCTIONS = tuple(sorted(set(_FUNCTIONS.values())))

#: Length of an AVX-512 register [doubles]; the number of lanes is a multiple.
VECTOR_WIDTH = 8

#: Length of a loop body up to which two turns are interleaved [lines]; longer ones would exceed the registers.
_MAX_INTERLEAVED_LINES = 340

#: Mark of a loop over lanes, with the number of interleaved turns (`with_vector_metadata`), and ``i`` for independence.
_LOOP_MARK = ", !llvm.loop !lanes_{}"

#: Pattern of these marks.
_LOOP_MARK_PATTERN = re.compile(r", !llvm\.loop !lanes_(\d)(i?)")

#: Name of the index of loops whose turns have entries of their own, where LLVM cannot see it: their loads and stores
#: are marked as independent of other turns.
INDEPENDENT_INDEX = "OWN_LANE"

#: Mark of such a load or store.
_ACCESS_MARK = ", !llvm.access.group !lane_entries"

_CONVERSIONS: dict[Any, str] = {np.float64: "double", np.int64: "i64", np.uint64: "word"}


def with_vector_metadata(text: str, has_avx512: bool) -> str:
    """Add vectorisation metadata to the marked loops over lanes of a module's text.

    LLVM's default on Intel processors is 256-bit vectors, and no interleaving of longer loops. Loops over lanes are
    faster with AVX-512 and, up to a length, with two interleaved turns, which hide the latency of dependent operations.

    Args:
        text: text of the module.
        has_avx512: whether the processor has AVX-512; without it only the independence of turns is stated.
    """
    head, *rest = _LOOP_MARK_PATTERN.split(text)
    marks = list(zip(rest[::3], rest[1::3], rest[2::3], strict=True))
    group = 3 + len(marks)
    body, loops, hints = head, "", ""
    for number, (turns, independent, part) in enumerate(marks, 3):
        properties = ["!0", f"!{turns}"] if has_avx512 else []
        properties += [f"!{group + 1}", f"!{group + 2}"] if independent else []
        body += f", !llvm.loop !{number}{part}" if properties else part
        loops += f"!{number} = distinct !{{{', '.join([f'!{number}', *properties])}}}\n" if properties else ""
    if loops and has_avx512:
        hints = f'!0 = !{{!"llvm.loop.vectorize.width", i32 {VECTOR_WIDTH}}}\n'
        hints += "".join(f'!{turns} = !{{!"llvm.loop.interleave.count", i32 {turns}}}\n' for turns in (1, 2))
    if any(independent for _, independent, _ in marks):
        loops += f'!{group} = distinct !{{}}\n!{group + 1} = !{{!"llvm.loop.parallel_accesses", !{group}}}\n'
        # Short loops would be unrolled before they are vectorised.
        loops += f'!{group + 2} = !{{!"llvm.loop.unroll.disable"}}\n'
        body = body.replace(_ACCESS_MARK, f", !llvm.access.group !{group}")
    return f"{body}{hints}{loops}"


def flat_types(nested_types: Any) -> list[str]:
    """The types in nested tuples of types, in order; an empty list for None."""
    if nested_types is None:
        return []
    return (
        [leaf for kind in nested_types for leaf in flat_types(kind)]
        if isinstance(nested_types, tuple)
        else [nested_types]
    )


class FunctionTranslation(LlvmArithmetic):
    """The translation of one function.

    Args:
        source: the function.
    """

    def __init__(self, source: FunctionSource) -> None:
        super().__init__(source.name)
        self.source = source
        self._block = "entry"
        self._called: dict[str, str] = {}

    def function(self, argument_types: ArgumentTypes) -> TranslatedFunction:
        """Translate the function for arguments of these types."""
        arguments: list[Scalar] = []

        def argument(kind: Any) -> Any:
            if isinstance(kind, tuple):
                return tuple(map(argument, kind))
            arguments.append(Scalar(kind, f"%a{len(arguments)}"))
            return arguments[-1]

        returned = self._inline(self.source, [argument(kind) for kind in argument_types])
        values = [] if returned is None else self.flatten(returned)
        type_ = "{ " + ", ".join(LLVM_TYPES[value.llvm_type] for value in values) + " }" if values else "void"
        returned_struct = "undef"
        for i, value in enumerate(values):
            self.lines.append(
                f"%r{i} = insertvalue {type_} {returned_struct}, {LLVM_TYPES[value.llvm_type]} {value.text}, {i}"
            )
            returned_struct = f"%r{i}"
        self.lines.append(f"ret {type_} {returned_struct}" if values else "ret void")
        parameters = ", ".join(f"{LLVM_TYPES[a.llvm_type]} {a.text}" for a in arguments)
        # A function without blocks is inlined into arithmetic; a function with blocks stays a function.
        inline = "" if "ptr" in argument_types else " alwaysinline"
        body = f"({parameters}){inline} {{\nentry:\n" + "\n".join(self.lines) + "\n}\n"
        # The body determines the function, with the names of the functions it calls.
        name = f"{self.source.function.__name__}.{hashlib.sha256(f'{type_}{body}'.encode()).hexdigest()[:16]}"
        result = None if returned is None else self.types_of(returned)
        return TranslatedFunction(name, {**self._called, name: f"define linkonce_odr {type_} @{name}{body}"}, result)

    def _inline(self, source: FunctionSource, arguments: Sequence[Any]) -> Any:
        """Write a function's lines in place, and return its result."""
        if len(arguments) != len(source.arguments):
            raise TypeError(
                f"{source.name} takes {source.arguments}, but is given {len(arguments)} arguments; give all"
            )
        outer, self.source, self.name = self.source, source, source.name
        returned = self._statements(source.tree.body, dict(zip(source.arguments, arguments, strict=True)))
        self.source, self.name = outer, outer.name
        return returned

    def _statements(self, body: Iterable[ast.stmt], names: dict[str, Any]) -> Any:
        """Write statements, and return their result."""
        for statement in body:
            match statement:
                case ast.Return(value=None):
                    return None
                case ast.Return():
                    return self._value(statement.value, names)
                case ast.Assign(targets=[target]):
                    self._assign(target, self._value(statement.value, names), names)
                case ast.AugAssign():
                    before, by = self._value(statement.target, names), self._value(statement.value, names)
                    self._assign(statement.target, self.binary(statement.op, before, by), names)
                case ast.For():
                    self._loop(statement, names)
                case ast.Expr():
                    self._value(statement.value, names)
                case _:
                    raise self._error(statement, "is not allowed in a scalar_jit function")
        return None

    def _assign(self, target: ast.expr, value: Any, names: dict[str, Any]) -> None:
        """Assign to a name, to the parts of a tuple, or to an entry of a block."""
        match target:
            case ast.Name():
                names[target.id] = value
            case ast.Tuple():
                for part, entry in zip(target.elts, value, strict=True):
                    self._assign(part, entry, names)
            case ast.Subscript():
                address = self._address(target, names)
                self.lines.append(f"store double {self.double(value)}, ptr {address}, align 8")
            case _:
                raise self._error(target, "cannot be assigned")

    def _loop(self, loop: ast.For, names: dict[str, Any]) -> None:
        """Write a loop; names assigned in it are local to a turn."""
        match loop.target, loop.iter, loop.orelse:
            case ast.Name() as target, ast.Call(func=function, args=[turns], keywords=[]), []:
                is_range = self._value(function, names) is range
            case _:
                is_range = False
        if not is_range or any(isinstance(node, ast.Return) for node in ast.walk(loop)):
            raise self._error(loop.iter, "is no plain loop over range(n)")
        count = self._value(turns, names)
        if target.id in names or (is_number(count) and count < 1):
            raise self._error(loop.iter, f"must have a turn, and a new name instead of {target.id}")
        end = self.integer(count)
        self.count += 1
        n, before, at = self.count, self._block, len(self.lines)
        self.lines += [f"br label %loop{n}", f"loop{n}:", ""]
        self._block = f"loop{n}"
        within = {**names, target.id: Scalar("i64", f"%i{n}")}
        self._statements(loop.body, within)
        kept = [name for name in names if name != target.id and within[name] is not names[name]]
        if kept:
            raise self._error(loop.iter, f"keeps {kept}, which must go into a block")
        self.lines[at + 2] = f"%i{n} = phi i64 [ 0, %{before} ], [ %n{n}, %{self._block} ]"
        self.lines += [f"%n{n} = add nsw i64 %i{n}, 1", f"%c{n} = icmp slt i64 %n{n}, {end}"]
        # Only the innermost loop can be vectorised, and LLVM complains of a mark on another.
        is_innermost = not any("call void" in line or " = phi " in line for line in self.lines[at + 3 :])
        is_of_lanes = is_number(count) and count % VECTOR_WIDTH == 0 and is_innermost
        marked = _LOOP_MARK.format(2 if len(self.lines) - at < _MAX_INTERLEAVED_LINES else 1) if is_of_lanes else ""
        if marked and target.id == INDEPENDENT_INDEX:
            marked += "i"
            self.lines[at:] = [
                line + _ACCESS_MARK if " = load double" in line or line.startswith("store double") else line
                for line in self.lines[at:]
            ]
        self.lines += [f"br i1 %c{n}, label %loop{n}, label %done{n}{marked}", f"done{n}:"]
        self._block = f"done{n}"

    def _value(self, node: Any, names: Mapping[str, Any]) -> Any:
        """The value of an expression: a `Scalar`, a number, a tuple, or a Python object."""
        match node:
            case ast.Constant():
                return node.value
            case ast.Name():
                return names[node.id] if node.id in names else self.source.resolve(node.id)
            case ast.Attribute():
                base = self._value(node.value, names)
                if isinstance(base, Scalar):
                    raise self._error(node, "asks a number or a block for an attribute")
                return getattr(base, node.attr)
            case ast.Tuple():
                return tuple(self._value(entry, names) for entry in node.elts)
            case ast.Subscript():
                base = self._value(node.value, names)
                if is_tuple(base):
                    return base[self._value(node.slice, names)]
                return self.emit("double", f"load double, ptr {self._address(node, names)}, align 8")
            case ast.UnaryOp():
                return self.unary(node.op, self._value(node.operand, names))
            case ast.BinOp():
                return self.binary(node.op, self._value(node.left, names), self._value(node.right, names))
            case ast.BoolOp():
                word = "and" if isinstance(node.op, ast.And) else "or"
                parts = [Scalar("i1", self.truth(self._value(part, names))) for part in node.values]
                return reduce(lambda a, b: self.emit("i1", f"{word} i1 {a.text}, {b.text}"), parts)
            case ast.Compare(ops=[order], comparators=[right]):
                return self.compare(type(order), self._value(node.left, names), self._value(right, names))
            case ast.IfExp():
                truth = self._value(node.test, names)
                if is_number(truth):
                    return self._value(node.body if truth else node.orelse, names)
                return self.select(self.truth(truth), self._value(node.body, names), self._value(node.orelse, names))
            case ast.Call():
                return self._call(node, names)
        raise self._error(node, "is not allowed in a scalar_jit function")

    def _address(self, node: ast.Subscript, names: Mapping[str, Any]) -> str:
        """Address of an entry of a block."""
        base = self._value(node.value, names)
        if not (isinstance(base, Scalar) and base.llvm_type == "ptr"):
            raise self._error(node, "is no entry of a block")
        at = self._value(node.slice, names)
        if is_number(at) and at < 0:
            raise self._error(node, "counts from the end")
        index = self.integer(at)
        return self.emit("ptr", f"getelementptr inbounds double, ptr {base.text}, i64 {index}").text

    def _call(self, node: ast.Call, names: Mapping[str, Any]) -> Any:
        """The value of a call."""
        if node.keywords:
            raise self._error(node, "gives arguments by name")
        if isinstance(node.func, ast.Attribute) and node.func.attr == "view":
            value, kind = self._value(node.func.value, names), _CONVERSIONS.get(self._value(node.args[0], names))
            if not isinstance(value, Scalar) or kind is None or value.llvm_type in ("i1", "ptr"):
                raise self._error(node, "views something else than the bits of a number")
            return self.emit(kind, f"bitcast {LLVM_TYPES[value.llvm_type]} {value.text} to {LLVM_TYPES[kind]}")
        function, operands = self._value(node.func, names), [self._value(argument, names) for argument in node.args]
        source = getattr(function, "source", None)
        if isinstance(source, FunctionSource):
            if any(isinstance(value, Scalar) and value.llvm_type == "ptr" for value in operands):
                return self._call_on_block(function, operands)
            return self._inline(source, operands)
        if function in (min, max) and len(operands) > 1:
            order = ast.Lt if function is min else ast.Gt
            return reduce(lambda a, b: self.select(self.compare(order, b, a).text, b, a), operands)
        if function in _CONVERSIONS and len(operands) == 1:
            return self.convert(_CONVERSIONS[function], operands[0])
        if function in _FUNCTIONS and len(operands) == 1:
            return self.emit(
                "double", f"call {FMA_FLAG} double @{_FUNCTIONS[function]}(double {self.double(operands[0])})"
            )
        raise self._error(node, "calls a function that scalar_jit cannot compile")

    def _call_on_block(self, function: Any, operands: Sequence[Any]) -> None:
        """Call a function with blocks, which writes its results into them."""
        values = tuple(self.scalar(value) if is_number(value) else value for value in operands)
        called = function.translate(self.types_of(values))
        if called.result is not None:
            raise TypeError(
                f"{self.name} calls {function.__name__}, which has a block and a result; write the result into a block"
            )
        self._called |= called.definitions
        flat = ", ".join(f"{LLVM_TYPES[value.llvm_type]} {value.text}" for value in self.flatten(values))
        self.lines.append(f"call void @{called.name}({flat})")

    def _error(self, node: ast.AST, what: str) -> TypeError:
        """The error for code that `scalar_jit` cannot compile."""
        text = textwrap.shorten(ast.unparse(node), 60)
        return TypeError(f"{text!r} in {self.name} {what}; compile it with jit instead")
