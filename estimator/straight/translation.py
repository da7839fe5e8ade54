"""From a syntax tree to the text of LLVM."""

from __future__ import annotations

import ast
import hashlib
import math
import struct
import textwrap
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import reduce
from typing import Any, NamedTuple

import numpy as np

from estimator.straight.source import Source

#: Of arguments or results: names of kinds, and tuples of them. The kinds are ``double``, ``i1`` (a truth), ``i64``,
#: ``word`` (64 bits without a sign, which LLVM does not tell from an i64) and ``ptr`` (a block).
Kinds = tuple[Any, ...]


class Scalar(NamedTuple):
    """A value in LLVM: its kind and its name, or a number as text."""

    kind: str
    text: str


class Translated(NamedTuple):
    """A function for arguments of certain kinds.

    Attributes:
        name: of its own in all compiled code: it holds a digest.
        definitions: name to text, of the function and of those that it calls.
        result: kinds that it returns; None where nothing.
    """

    name: str
    definitions: Mapping[str, str]
    result: Any


#: Functions of one number, and what LLVM or the C library calls them.
_FUNCTIONS: dict[Callable[..., Any], str] = {
    math.sqrt: "llvm.sqrt.f64", np.sqrt: "llvm.sqrt.f64", math.floor: "llvm.floor.f64", abs: "llvm.fabs.f64",
    math.exp: "llvm.exp.f64", math.log: "llvm.log.f64", math.log1p: "log1p",
}  # fmt: skip

#: What every text must declare.
EXTERNAL = tuple(sorted(set(_FUNCTIONS.values())))

_FUSED = "contract"
_CONVERSIONS: dict[Any, str] = {np.float64: "double", np.int64: "i64", np.uint64: "word"}
_LLVM = {"double": "double", "i1": "i1", "i64": "i64", "word": "i64", "ptr": "ptr"}
_ORDER = {ast.Lt: "lt", ast.LtE: "le", ast.Gt: "gt", ast.GtE: "ge", ast.Eq: "eq", ast.NotEq: "ne"}
_FLOATS = {ast.Add: "fadd", ast.Sub: "fsub", ast.Mult: "fmul", ast.Div: "fdiv"}
_WHOLES = {
    ast.Add: "add", ast.Sub: "sub", ast.Mult: "mul", ast.FloorDiv: "sdiv", ast.Mod: "srem",
    ast.LShift: "shl", ast.BitAnd: "and", ast.BitOr: "or", ast.BitXor: "xor",
}  # fmt: skip


def leaves(kinds: Any) -> list[str]:
    """The kinds in tuples of kinds, in order; none of None."""
    if kinds is None:
        return []
    return [leaf for kind in kinds for leaf in leaves(kind)] if isinstance(kinds, tuple) else [kinds]


def _is_number(value: Any) -> bool:
    return isinstance(value, bool | int | float | np.generic)


def _is_tuple(value: Any) -> bool:
    return isinstance(value, tuple) and not isinstance(value, Scalar)


class Translation:
    """The text of one function.

    Args:
        source: of the function.
    """

    def __init__(self, source: Source) -> None:
        self.source = source
        self._lines: list[str] = []
        self._block = "entry"
        self._count = 0
        self._called: dict[str, str] = {}

    def whole(self, kinds: Kinds) -> Translated:
        """The function for arguments of these kinds."""
        arguments: list[Scalar] = []

        def argument(kind: Any) -> Any:
            if isinstance(kind, tuple):
                return tuple(map(argument, kind))
            arguments.append(Scalar(kind, f"%a{len(arguments)}"))
            return arguments[-1]

        returned = self._inlined(self.source, [argument(kind) for kind in kinds])
        values = [] if returned is None else self._flat(returned)
        type_ = "{ " + ", ".join(_LLVM[value.kind] for value in values) + " }" if values else "void"
        answer = "undef"
        for i, value in enumerate(values):
            self._lines.append(f"%r{i} = insertvalue {type_} {answer}, {_LLVM[value.kind]} {value.text}, {i}")
            answer = f"%r{i}"
        self._lines.append(f"ret {type_} {answer}" if values else "ret void")
        taken = ", ".join(f"{_LLVM[a.kind]} {a.text}" for a in arguments)
        # What has no block is called in the midst of arithmetic.
        inline = "" if "ptr" in kinds else " alwaysinline"
        body = f"({taken}){inline} {{\nentry:\n" + "\n".join(self._lines) + "\n}\n"
        # All that a function depends on stands in its body, or in the names of those that it calls.
        name = f"{self.source.function.__name__}.{hashlib.sha256(f'{type_}{body}'.encode()).hexdigest()[:16]}"
        result = None if returned is None else self._kinds(returned)
        return Translated(name, {**self._called, name: f"define linkonce_odr {type_} @{name}{body}"}, result)

    def _inlined(self, source: Source, arguments: Sequence[Any]) -> Any:
        """Write a function's lines here; what it returns."""
        outer, self.source = self.source, source
        returned = self._statements(source.tree.body, dict(zip(source.arguments, arguments, strict=True)))
        self.source = outer
        return returned

    def _statements(self, body: Iterable[ast.stmt], names: dict[str, Any]) -> Any:
        """Write statements; what they return."""
        for statement in body:
            match statement:
                case ast.Return(value=None):
                    return None
                case ast.Return():
                    return self._value(statement.value, names)
                case ast.Assign():
                    self._assign(statement.targets[0], self._value(statement.value, names), names)
                case ast.AugAssign():
                    before, by = self._value(statement.target, names), self._value(statement.value, names)
                    self._assign(statement.target, self._binary(statement.op, before, by), names)
                case ast.For():
                    self._loop(statement, names)
                case ast.Expr():
                    self._value(statement.value, names)
                case _:
                    raise self._error(statement, "stands in no straight function")
        return None

    def _assign(self, target: ast.expr, value: Any, names: dict[str, Any]) -> None:
        """Give a name, the parts of a tuple, or the entry of a block its value."""
        match target:
            case ast.Name():
                names[target.id] = value
            case ast.Tuple():
                for part, entry in zip(target.elts, value, strict=True):
                    self._assign(part, entry, names)
            case ast.Subscript():
                place = self._place(target, names)
                self._lines.append(f"store double {self._double(value)}, ptr {place}, align 8")
            case _:
                raise self._error(target, "cannot be assigned")

    def _loop(self, loop: ast.For, names: dict[str, Any]) -> None:
        """Write a loop; what it assigns is forgotten after each turn."""
        turns, target = loop.iter, loop.target
        if not (isinstance(turns, ast.Call) and isinstance(target, ast.Name) and len(turns.args) == 1):
            raise self._error(loop.iter, "is no range(n)")
        end = self._whole(self._value(turns.args[0], names))
        self._count += 1
        n, before, at = self._count, self._block, len(self._lines)
        self._lines += [f"br label %loop{n}", f"loop{n}:", ""]
        self._block = f"loop{n}"
        within = {**names, target.id: Scalar("i64", f"%i{n}")}
        self._statements(loop.body, within)
        kept = [name for name in names if name != target.id and within[name] is not names[name]]
        if kept:
            raise self._error(loop.iter, f"keeps {kept}, which must go into a block")
        self._lines[at + 2] = f"%i{n} = phi i64 [ 0, %{before} ], [ %n{n}, %{self._block} ]"
        self._lines += [f"%n{n} = add nsw i64 %i{n}, 1", f"%c{n} = icmp slt i64 %n{n}, {end}"]
        self._lines += [f"br i1 %c{n}, label %loop{n}, label %done{n}", f"done{n}:"]
        self._block = f"done{n}"

    def _value(self, node: Any, names: Mapping[str, Any]) -> Any:
        """The value of an expression: a `Scalar`, a number, a tuple, or what a name stands for."""
        match node:
            case ast.Constant():
                return node.value
            case ast.Name():
                return names[node.id] if node.id in names else self.source.resolve(node.id)
            case ast.Attribute():
                return getattr(self._value(node.value, names), node.attr)
            case ast.Tuple():
                return tuple(self._value(entry, names) for entry in node.elts)
            case ast.Subscript():
                base = self._value(node.value, names)
                if _is_tuple(base):
                    return base[self._value(node.slice, names)]
                return self._op("double", f"load double, ptr {self._place(node, names)}, align 8")
            case ast.UnaryOp():
                return self._unary(node.op, self._value(node.operand, names))
            case ast.BinOp():
                return self._binary(node.op, self._value(node.left, names), self._value(node.right, names))
            case ast.BoolOp():
                word = "and" if isinstance(node.op, ast.And) else "or"
                parts = [Scalar("i1", self._truth(self._value(part, names))) for part in node.values]
                return reduce(lambda a, b: self._op("i1", f"{word} i1 {a.text}, {b.text}"), parts)
            case ast.Compare(ops=[order], comparators=[right]):
                return self._compared(type(order), self._value(node.left, names), self._value(right, names))
            case ast.IfExp():
                truth = self._value(node.test, names)
                if _is_number(truth):
                    return self._value(node.body if truth else node.orelse, names)
                return self._chosen(self._truth(truth), self._value(node.body, names), self._value(node.orelse, names))
            case ast.Call():
                return self._call(node, names)
        raise self._error(node, "stands in no straight function")

    def _place(self, node: ast.Subscript, names: Mapping[str, Any]) -> str:
        """Where the entry of a block lies."""
        base = self._value(node.value, names)
        if not (isinstance(base, Scalar) and base.kind == "ptr"):
            raise self._error(node, "is no entry of a block")
        index = self._whole(self._value(node.slice, names))
        return self._op("ptr", f"getelementptr inbounds double, ptr {base.text}, i64 {index}").text

    def _call(self, node: ast.Call, names: Mapping[str, Any]) -> Any:
        """The value of a call."""
        if isinstance(node.func, ast.Attribute) and node.func.attr == "view":
            value, kind = self._value(node.func.value, names), _CONVERSIONS[self._value(node.args[0], names)]
            return self._op(kind, f"bitcast {_LLVM[value.kind]} {value.text} to {_LLVM[kind]}")
        function, given = self._value(node.func, names), [self._value(argument, names) for argument in node.args]
        source = getattr(function, "source", None)
        if isinstance(source, Source):
            if any(isinstance(value, Scalar) and value.kind == "ptr" for value in given):
                return self._call_on_block(function, given)
            return self._inlined(source, given)
        if function in (min, max):
            order = ast.Lt if function is min else ast.Gt
            return reduce(lambda a, b: self._chosen(self._compared(order, b, a).text, b, a), given)
        if function in _CONVERSIONS:
            return self._converted(_CONVERSIONS[function], given[0])
        if function in _FUNCTIONS:
            return self._op("double", f"call {_FUSED} double @{_FUNCTIONS[function]}(double {self._double(given[0])})")
        raise self._error(node, "calls what is not straight")

    def _call_on_block(self, function: Any, given: Sequence[Any]) -> None:
        """Call a function of blocks, which is one of its own for LLVM too, and leaves its results in them."""
        values = tuple(self._scalar(value) if _is_number(value) else value for value in given)
        called = function.translated(self._kinds(values))
        self._called |= called.definitions
        flat = ", ".join(f"{_LLVM[value.kind]} {value.text}" for value in self._flat(values))
        self._lines.append(f"call void @{called.name}({flat})")

    def _op(self, kind: str, text: str) -> Scalar:
        """Write a line that makes a value."""
        self._count += 1
        self._lines.append(f"%v{self._count} = {text}")
        return Scalar(kind, f"%v{self._count}")

    def _unary(self, operator: ast.unaryop, value: Any) -> Any:
        """A sign or ``not``."""
        if isinstance(operator, ast.Not):
            return self._op("i1", f"xor i1 {self._truth(value)}, true")
        if _is_number(value):
            return -value
        if value.kind == "double":
            return self._op("double", f"fneg {_FUSED} double {value.text}")
        return self._op(value.kind, f"sub i64 0, {value.text}")

    def _binary(self, operator: ast.operator, a: Any, b: Any) -> Any:
        """Arithmetic of two values."""
        how = type(operator)
        if _is_number(a) and _is_number(b):
            tree = ast.Expression(ast.BinOp(ast.Name("a", ast.Load()), operator, ast.Name("b", ast.Load())))
            return eval(compile(ast.fix_missing_locations(tree), "", "eval"), {"a": a, "b": b})
        if how is ast.Pow and _is_number(b) and b in range(1, 9):
            return reduce(lambda x, y: self._binary(ast.Mult(), x, y), [a] * int(b))
        kinds = {x.kind if isinstance(x, Scalar) else "double" if isinstance(x, float) else "whole" for x in (a, b)}
        if how in (ast.BitAnd, ast.BitOr) and kinds == {"i1"}:
            return self._op("i1", f"{_WHOLES[how]} i1 {a.text}, {b.text}")
        if how is ast.Div or "double" in kinds:
            if how not in _FLOATS:
                raise TypeError(f"{how.__name__} of floats stands in {self.source.function.__qualname__}")
            return self._op("double", f"{_FLOATS[how]} {_FUSED} double {self._double(a)}, {self._double(b)}")
        kind = "word" if "word" in kinds else "i64"
        name = ("lshr" if kind == "word" else "ashr") if how is ast.RShift else _WHOLES[how]
        return self._op(kind, f"{name} i64 {self._whole(a)}, {self._whole(b)}")

    def _compared(self, order: type[ast.cmpop], a: Any, b: Any) -> Scalar:
        """The truth of a comparison, which does not hold with NaN but for ``!=``."""
        word = _ORDER[order]
        if all(isinstance(x, int) or (isinstance(x, Scalar) and x.kind in ("i64", "word")) for x in (a, b)):
            is_word = any(isinstance(x, Scalar) and x.kind == "word" for x in (a, b))
            sign = "" if word in ("eq", "ne") else "u" if is_word else "s"
            return self._op("i1", f"icmp {sign}{word} i64 {self._whole(a)}, {self._whole(b)}")
        ordered = "u" if word == "ne" else "o"
        return self._op("i1", f"fcmp {_FUSED} {ordered}{word} double {self._double(a)}, {self._double(b)}")

    def _chosen(self, truth: str, a: Any, b: Any) -> Scalar:
        """The first of two values where something is true, else the second."""
        if isinstance(a, Scalar) and isinstance(b, Scalar) and a.kind == b.kind:
            return self._op(a.kind, f"select i1 {truth}, {_LLVM[a.kind]} {a.text}, {_LLVM[b.kind]} {b.text}")
        return self._op("double", f"select i1 {truth}, double {self._double(a)}, double {self._double(b)}")

    def _truth(self, value: Any) -> str:
        """A value as a truth."""
        if _is_number(value):
            return "true" if value else "false"
        if value.kind == "double":
            return self._op("i1", f"fcmp {_FUSED} une double {value.text}, 0.0").text
        return str(value.text) if value.kind == "i1" else self._op("i1", f"icmp ne i64 {value.text}, 0").text

    def _converted(self, kind: str, value: Any) -> Scalar:
        """A value as a number of another kind."""
        if kind == "double":
            return Scalar(kind, self._double(value))
        if _is_number(value) or value.kind != "double":
            return Scalar(kind, self._whole(value))
        return self._op(kind, f"{'fptosi' if kind == 'i64' else 'fptoui'} double {value.text} to i64")

    def _double(self, value: Any) -> str:
        """A value as a double."""
        if _is_number(value):
            return f"0x{struct.pack('>d', float(value)).hex()}"
        if value.kind == "double":
            return str(value.text)
        how = {"i1": "uitofp i1", "i64": "sitofp i64", "word": "uitofp i64"}[value.kind]
        return self._op("double", f"{how} {value.text} to double").text

    def _whole(self, value: Any) -> str:
        """A value as a whole number."""
        if _is_number(value) and not isinstance(value, float):
            return str(int(value))
        if _is_number(value) or value.kind == "double":
            raise TypeError(f"a whole number is needed in {self.source.function.__qualname__}, and not a float")
        return self._op("i64", f"zext i1 {value.text} to i64").text if value.kind == "i1" else str(value.text)

    def _scalar(self, number: Any) -> Scalar:
        """A number as a value."""
        is_whole = isinstance(number, int | np.integer) and not isinstance(number, bool)
        return Scalar("i64", self._whole(number)) if is_whole else Scalar("double", self._double(number))

    def _flat(self, value: Any) -> list[Scalar]:
        """The numbers in tuples of tuples."""
        if _is_tuple(value):
            return [leaf for entry in value for leaf in self._flat(entry)]
        return [value if isinstance(value, Scalar) else Scalar("double", self._double(value))]

    def _kinds(self, value: Any) -> Any:
        """The kinds of a value."""
        if _is_tuple(value):
            return tuple(map(self._kinds, value))
        return value.kind if isinstance(value, Scalar) else "double"

    def _error(self, node: ast.AST, what: str) -> TypeError:
        """That a function is not straight."""
        text = textwrap.shorten(ast.unparse(node), 60)
        return TypeError(f"{text!r} in {self.source.function.__qualname__} {what}; compile it with jit instead")
