"""Arithmetic and comparisons as LLVM text, for `scalar_jit`."""

from __future__ import annotations

import ast
import struct
from functools import reduce
from typing import Any, NamedTuple

import numpy as np

#: LLVM flag: a multiplication and an addition may be fused, without any other reordering.
FMA_FLAG = "contract"

LLVM_TYPES = {"double": "double", "i1": "i1", "i64": "i64", "word": "i64", "ptr": "ptr"}
_COMPARISONS = {ast.Lt: "lt", ast.LtE: "le", ast.Gt: "gt", ast.GtE: "ge", ast.Eq: "eq", ast.NotEq: "ne"}
_FLOAT_OPERATIONS = {ast.Add: "fadd", ast.Sub: "fsub", ast.Mult: "fmul", ast.Div: "fdiv"}
_SIGNED_OPERATIONS: dict[type[ast.operator], str] = {ast.RShift: "ashr"}
_UNSIGNED_OPERATIONS: dict[type[ast.operator], str] = {ast.RShift: "lshr", ast.FloorDiv: "udiv", ast.Mod: "urem"}
_INTEGER_OPERATIONS: dict[type[ast.operator], str] = {
    ast.Add: "add", ast.Sub: "sub", ast.Mult: "mul", ast.FloorDiv: "sdiv", ast.Mod: "srem",
    ast.LShift: "shl", ast.BitAnd: "and", ast.BitOr: "or", ast.BitXor: "xor",
}  # fmt: skip


class Scalar(NamedTuple):
    """A value in LLVM.

    Attributes:
        llvm_type: ``double``, ``i1`` (a boolean), ``i64``, ``word`` (an unsigned i64) or ``ptr`` (a block).
        text: name of the value, or a number.
    """

    llvm_type: str
    text: str


def is_number(value: Any) -> bool:
    """Whether a value is a number of Python or NumPy, known at translation."""
    return isinstance(value, bool | int | float | np.generic)


def is_float(value: Any) -> bool:
    """Whether a value is a floating-point number."""
    return isinstance(value, float | np.floating)


def is_tuple(value: Any) -> bool:
    """Whether a value is a tuple of values."""
    return isinstance(value, tuple) and not isinstance(value, Scalar)


class LlvmArithmetic:
    """Lines of a function, and the operations that write them. A value is a `Scalar` or a number.

    Args:
        name: name of the function, for messages.
    """

    def __init__(self, name: str) -> None:
        self.name = name
        self.lines: list[str] = []
        self.count = 0

    def emit(self, result_type: str, text: str) -> Scalar:
        """Write a line that defines a value."""
        self.count += 1
        self.lines.append(f"%v{self.count} = {text}")
        return Scalar(result_type, f"%v{self.count}")

    def unary(self, operator: ast.unaryop, value: Any) -> Any:
        """A sign or ``not``."""
        if isinstance(operator, ast.Not):
            return self.emit("i1", f"xor i1 {self.truth(value)}, true")
        if not isinstance(operator, ast.USub) or (isinstance(value, Scalar) and value.llvm_type in ("i1", "ptr")):
            raise TypeError(f"{self.name} negates a value that is not a number; apply a minus to numbers only")
        if is_number(value):
            return -value
        if value.llvm_type == "double":
            return self.emit("double", f"fneg {FMA_FLAG} double {value.text}")
        return self.emit(value.llvm_type, f"sub i64 0, {value.text}")

    def binary(self, operator: ast.operator, a: Any, b: Any) -> Any:
        """Arithmetic of two values."""
        operation = type(operator)
        if is_number(a) and is_number(b):
            tree = ast.Expression(ast.BinOp(ast.Name("a", ast.Load()), operator, ast.Name("b", ast.Load())))
            return eval(compile(ast.fix_missing_locations(tree), "", "eval"), {"a": a, "b": b})
        if operation is ast.Pow and is_number(b) and b in range(1, 9):
            return reduce(lambda x, y: self.binary(ast.Mult(), x, y), [a] * int(b))
        operand_types = {
            x.llvm_type if isinstance(x, Scalar) else self.scalar(x).llvm_type if is_float(x) else "" for x in (a, b)
        }
        if operation in (ast.BitAnd, ast.BitOr) and operand_types == {"i1"}:
            return self.emit("i1", f"{_INTEGER_OPERATIONS[operation]} i1 {a.text}, {b.text}")
        if operation is ast.Div or "double" in operand_types:
            if operation not in _FLOAT_OPERATIONS:
                raise TypeError(f"{self.name} has {operation.__name__} of floats; compile it with jit instead")
            return self.emit(
                "double", f"{_FLOAT_OPERATIONS[operation]} {FMA_FLAG} double {self.double(a)}, {self.double(b)}"
            )
        result_type = "word" if "word" in operand_types else "i64"
        name = (_UNSIGNED_OPERATIONS if result_type == "word" else _SIGNED_OPERATIONS).get(
            operation
        ) or _INTEGER_OPERATIONS.get(operation)
        if name is None or operand_types >= {"i64", "word"}:
            raise TypeError(
                f"{self.name} has {operation.__name__} of {sorted(operand_types - {''})}; convert one, or use jit"
            )
        return self.emit(result_type, f"{name} i64 {self.integer(a)}, {self.integer(b)}")

    def compare(self, comparison: type[ast.cmpop], a: Any, b: Any) -> Scalar:
        """A comparison; with NaN it is false, except ``!=``."""
        if comparison not in _COMPARISONS:
            raise TypeError(f"{self.name} compares by {comparison.__name__}; use < <= > >= == or !=")
        predicate = _COMPARISONS[comparison]
        if all(x.llvm_type in ("i64", "word") if isinstance(x, Scalar) else not is_float(x) for x in (a, b)):
            is_word = any(isinstance(x, Scalar) and x.llvm_type == "word" for x in (a, b))
            sign = "" if predicate in ("eq", "ne") else "u" if is_word else "s"
            return self.emit("i1", f"icmp {sign}{predicate} i64 {self.integer(a)}, {self.integer(b)}")
        nan_prefix = "u" if predicate == "ne" else "o"
        return self.emit("i1", f"fcmp {FMA_FLAG} {nan_prefix}{predicate} double {self.double(a)}, {self.double(b)}")

    def select(self, condition: str, a: Any, b: Any) -> Scalar:
        """The first value if the condition is true, else the second."""
        a, b = (self.scalar(x) if is_number(x) else x for x in (a, b))
        if is_tuple(a) or is_tuple(b):
            raise TypeError(f"{self.name} chooses between tuples; choose between their parts")
        if a.llvm_type == b.llvm_type:
            return self.emit(
                a.llvm_type,
                f"select i1 {condition}, {LLVM_TYPES[a.llvm_type]} {a.text}, {LLVM_TYPES[b.llvm_type]} {b.text}",
            )
        return self.emit("double", f"select i1 {condition}, double {self.double(a)}, double {self.double(b)}")

    def truth(self, value: Any) -> str:
        """A value as a boolean."""
        if is_number(value):
            return "true" if value else "false"
        if value.llvm_type == "double":
            return self.emit("i1", f"fcmp {FMA_FLAG} une double {value.text}, 0.0").text
        return str(value.text) if value.llvm_type == "i1" else self.emit("i1", f"icmp ne i64 {value.text}, 0").text

    def convert(self, to_type: str, value: Any) -> Scalar:
        """A value converted to another type."""
        if to_type == "double":
            return Scalar(to_type, self.double(value))
        if is_number(value) or value.llvm_type != "double":
            return Scalar(to_type, self.integer(value))
        return self.emit(to_type, f"{'fptosi' if to_type == 'i64' else 'fptoui'} double {value.text} to i64")

    def double(self, value: Any) -> str:
        """A value as a double."""
        if is_number(value):
            return f"0x{struct.pack('>d', float(value)).hex()}"
        if value.llvm_type == "double":
            return str(value.text)
        conversion = {"i1": "uitofp i1", "i64": "sitofp i64", "word": "uitofp i64"}[value.llvm_type]
        return self.emit("double", f"{conversion} {value.text} to double").text

    def integer(self, value: Any) -> str:
        """A value as an integer."""
        if is_number(value) and not is_float(value):
            return str(int(value))
        if is_number(value) or value.llvm_type == "double":
            raise TypeError(f"{self.name} needs an integer, but has a float; convert it with numpy.int64")
        return self.emit("i64", f"zext i1 {value.text} to i64").text if value.llvm_type == "i1" else str(value.text)

    def scalar(self, number: Any) -> Scalar:
        """A number as a `Scalar`."""
        if isinstance(number, bool | np.bool_):
            return Scalar("i1", self.truth(number))
        return Scalar("double", self.double(number)) if is_float(number) else Scalar("i64", self.integer(number))

    def flatten(self, value: Any) -> list[Scalar]:
        """The numbers in tuples of tuples."""
        if is_tuple(value):
            return [leaf for entry in value for leaf in self.flatten(entry)]
        return [value if isinstance(value, Scalar) else self.scalar(value)]

    def types_of(self, value: Any) -> Any:
        """The types of a value."""
        if is_tuple(value):
            return tuple(map(self.types_of, value))
        return value.llvm_type if isinstance(value, Scalar) else self.scalar(value).llvm_type
