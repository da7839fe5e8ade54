"""Arithmetic in the text of LLVM."""

from __future__ import annotations

import ast
import struct
from functools import reduce
from typing import Any, NamedTuple

import numpy as np

#: A multiplication and an addition may be fused into one operation; nothing else may be reordered.
FUSED = "contract"

LLVM = {"double": "double", "i1": "i1", "i64": "i64", "word": "i64", "ptr": "ptr"}
_ORDER = {ast.Lt: "lt", ast.LtE: "le", ast.Gt: "gt", ast.GtE: "ge", ast.Eq: "eq", ast.NotEq: "ne"}
_FLOATS = {ast.Add: "fadd", ast.Sub: "fsub", ast.Mult: "fmul", ast.Div: "fdiv"}
_SIGNED: dict[type[ast.operator], str] = {ast.RShift: "ashr"}
_UNSIGNED: dict[type[ast.operator], str] = {ast.RShift: "lshr", ast.FloorDiv: "udiv", ast.Mod: "urem"}
_WHOLES: dict[type[ast.operator], str] = {
    ast.Add: "add", ast.Sub: "sub", ast.Mult: "mul", ast.FloorDiv: "sdiv", ast.Mod: "srem",
    ast.LShift: "shl", ast.BitAnd: "and", ast.BitOr: "or", ast.BitXor: "xor",
}  # fmt: skip


class Scalar(NamedTuple):
    """A value in LLVM: its kind and its name, or a number as text.

    Kinds are ``double``, ``i1`` (a truth), ``i64``, ``word`` (64 bits without a sign, which LLVM does not tell from an
    i64) and ``ptr`` (a block).
    """

    kind: str
    text: str


def is_number(value: Any) -> bool:
    """Whether a value is a number of Python or NumPy, known while the text is written."""
    return isinstance(value, bool | int | float | np.generic)


def is_float(value: Any) -> bool:
    """Whether a value is a number that need not be whole."""
    return isinstance(value, float | np.floating)


def is_tuple(value: Any) -> bool:
    """Whether a value is a tuple of values."""
    return isinstance(value, tuple) and not isinstance(value, Scalar)


class Arithmetic:
    """Lines of a function, and the operations that write them. A value is a `Scalar`, or a number.

    Args:
        name: of the function, for messages.
    """

    def __init__(self, name: str) -> None:
        self.name = name
        self.lines: list[str] = []
        self.count = 0

    def op(self, kind: str, text: str) -> Scalar:
        """Write a line that makes a value."""
        self.count += 1
        self.lines.append(f"%v{self.count} = {text}")
        return Scalar(kind, f"%v{self.count}")

    def unary(self, operator: ast.unaryop, value: Any) -> Any:
        """A sign or ``not``."""
        if isinstance(operator, ast.Not):
            return self.op("i1", f"xor i1 {self.truth(value)}, true")
        if not isinstance(operator, ast.USub) or (isinstance(value, Scalar) and value.kind in ("i1", "ptr")):
            raise TypeError(
                f"{self.name} changes the sign of something that is not a number; negate numbers with a minus"
            )
        if is_number(value):
            return -value
        if value.kind == "double":
            return self.op("double", f"fneg {FUSED} double {value.text}")
        return self.op(value.kind, f"sub i64 0, {value.text}")

    def binary(self, operator: ast.operator, a: Any, b: Any) -> Any:
        """Arithmetic of two values."""
        how = type(operator)
        if is_number(a) and is_number(b):
            tree = ast.Expression(ast.BinOp(ast.Name("a", ast.Load()), operator, ast.Name("b", ast.Load())))
            return eval(compile(ast.fix_missing_locations(tree), "", "eval"), {"a": a, "b": b})
        if how is ast.Pow and is_number(b) and b in range(1, 9):
            return reduce(lambda x, y: self.binary(ast.Mult(), x, y), [a] * int(b))
        kinds = {x.kind if isinstance(x, Scalar) else self.scalar(x).kind if is_float(x) else "" for x in (a, b)}
        if how in (ast.BitAnd, ast.BitOr) and kinds == {"i1"}:
            return self.op("i1", f"{_WHOLES[how]} i1 {a.text}, {b.text}")
        if how is ast.Div or "double" in kinds:
            if how not in _FLOATS:
                raise TypeError(f"{how.__name__} of floats stands in {self.name}")
            return self.op("double", f"{_FLOATS[how]} {FUSED} double {self.double(a)}, {self.double(b)}")
        kind = "word" if "word" in kinds else "i64"
        name = (_UNSIGNED if kind == "word" else _SIGNED).get(how) or _WHOLES.get(how)
        if name is None or kinds >= {"i64", "word"}:
            raise TypeError(f"{self.name} has {how.__name__} of {sorted(kinds - {''})}; convert one, or use jit")
        return self.op(kind, f"{name} i64 {self.integer(a)}, {self.integer(b)}")

    def compared(self, order: type[ast.cmpop], a: Any, b: Any) -> Scalar:
        """The truth of a comparison, which does not hold with NaN but for ``!=``."""
        if order not in _ORDER:
            raise TypeError(f"{self.name} compares by {order.__name__}; use < <= > >= == or !=")
        word = _ORDER[order]
        if all(x.kind in ("i64", "word") if isinstance(x, Scalar) else not is_float(x) for x in (a, b)):
            is_word = any(isinstance(x, Scalar) and x.kind == "word" for x in (a, b))
            sign = "" if word in ("eq", "ne") else "u" if is_word else "s"
            return self.op("i1", f"icmp {sign}{word} i64 {self.integer(a)}, {self.integer(b)}")
        ordered = "u" if word == "ne" else "o"
        return self.op("i1", f"fcmp {FUSED} {ordered}{word} double {self.double(a)}, {self.double(b)}")

    def chosen(self, truth: str, a: Any, b: Any) -> Scalar:
        """The first of two values where something is true, else the second."""
        a, b = (self.scalar(x) if is_number(x) else x for x in (a, b))
        if is_tuple(a) or is_tuple(b):
            raise TypeError(f"{self.name} chooses between tuples; choose between their parts")
        if a.kind == b.kind:
            return self.op(a.kind, f"select i1 {truth}, {LLVM[a.kind]} {a.text}, {LLVM[b.kind]} {b.text}")
        return self.op("double", f"select i1 {truth}, double {self.double(a)}, double {self.double(b)}")

    def truth(self, value: Any) -> str:
        """A value as a truth."""
        if is_number(value):
            return "true" if value else "false"
        if value.kind == "double":
            return self.op("i1", f"fcmp {FUSED} une double {value.text}, 0.0").text
        return str(value.text) if value.kind == "i1" else self.op("i1", f"icmp ne i64 {value.text}, 0").text

    def converted(self, kind: str, value: Any) -> Scalar:
        """A value as a number of another kind."""
        if kind == "double":
            return Scalar(kind, self.double(value))
        if is_number(value) or value.kind != "double":
            return Scalar(kind, self.integer(value))
        return self.op(kind, f"{'fptosi' if kind == 'i64' else 'fptoui'} double {value.text} to i64")

    def double(self, value: Any) -> str:
        """A value as a double."""
        if is_number(value):
            return f"0x{struct.pack('>d', float(value)).hex()}"
        if value.kind == "double":
            return str(value.text)
        how = {"i1": "uitofp i1", "i64": "sitofp i64", "word": "uitofp i64"}[value.kind]
        return self.op("double", f"{how} {value.text} to double").text

    def integer(self, value: Any) -> str:
        """A value as a whole number."""
        if is_number(value) and not is_float(value):
            return str(int(value))
        if is_number(value) or value.kind == "double":
            raise TypeError(f"a whole number is needed in {self.name}, and not a float")
        return self.op("i64", f"zext i1 {value.text} to i64").text if value.kind == "i1" else str(value.text)

    def scalar(self, number: Any) -> Scalar:
        """A number as a value."""
        if isinstance(number, bool | np.bool_):
            return Scalar("i1", self.truth(number))
        return Scalar("double", self.double(number)) if is_float(number) else Scalar("i64", self.integer(number))

    def flat(self, value: Any) -> list[Scalar]:
        """The numbers in tuples of tuples."""
        if is_tuple(value):
            return [leaf for entry in value for leaf in self.flat(entry)]
        return [value if isinstance(value, Scalar) else self.scalar(value)]

    def kinds(self, value: Any) -> Any:
        """The kinds of a value."""
        if is_tuple(value):
            return tuple(map(self.kinds, value))
        return value.kind if isinstance(value, Scalar) else self.scalar(value).kind
