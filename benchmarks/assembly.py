"""Operations of a compiled lane function, counted in its assembly.

A function of `estimator.lanes.lanewise` compiles to one loop over lanes, more or less unrolled, in which every packed
instruction does one operation for each lane of a vector. Each pass writes every output row once (or not at all, where
the row would stay as it is), so the number of passes in the text is known from its stores, and

    operations per lane = packed instructions / passes

whatever the vector width and the unrolling. A fused multiply-add counts as two operations; comparisons, selections,
conversions, integer and bit operations count as none.
"""

from __future__ import annotations

import dis
import inspect
import math
import platform
import re
from dataclasses import dataclass
from typing import Any

from numba import types

_BLOCK = types.Array(types.float64, 1, "C")
_INSTRUCTION = re.compile(r"^\s+(v\w+)\s+([^#\n]*)")
_REGISTER = re.compile(r"%([xyz])mm\d+")
_BITS = {"x": 128, "y": 256, "z": 512}
_ARITHMETIC = re.compile(
    r"^v(?:(?P<simple>add|sub|mul)|(?P<fused>fn?m(?:add|sub)(?:132|213|231))|(?P<division>div)|(?P<root>sqrt))"
    r"(?:p|(?P<scalar>s))d$"
)
_LABEL = re.compile(r"^(\.L\w+):")
_MASK = re.compile(r"\{%k\d\}")
_STACK = re.compile(r"\(%r[sb]p")


class NotCounted(RuntimeError):
    """The operations cannot be counted; the message says why."""


@dataclass(frozen=True)
class Operations:
    """Operations per lane.

    Attributes:
        simple: additions, subtractions and multiplications that are not fused.
        fused: fused multiply-adds, each two operations.
        divisions: divisions.
        roots: square roots.
        loads: loads from memory, of constants too.
        stores: stores to memory.
        vector_bits: width of the vectors.
    """

    simple: float = 0
    fused: float = 0
    divisions: float = 0
    roots: float = 0
    loads: float = 0
    stores: float = 0
    vector_bits: int = 0

    @property
    def flops(self) -> float:
        """Floating-point operations."""
        return self.simple + 2 * self.fused + self.divisions + self.roots

    def __add__(self, other: Operations) -> Operations:
        return Operations(
            self.simple + other.simple,
            self.fused + other.fused,
            self.divisions + other.divisions,
            self.roots + other.roots,
            self.loads + other.loads,
            self.stores + other.stores,
            max(self.vector_bits, other.vector_bits),
        )

    def __mul__(self, times: float) -> Operations:
        return Operations(
            times * self.simple,
            times * self.fused,
            times * self.divisions,
            times * self.roots,
            times * self.loads,
            times * self.stores,
            self.vector_bits,
        )


def count(function: Any) -> Operations:
    """Count the operations of a function of `lanewise`.

    Raises:
        NotCounted: if the processor is no x86-64, or the loop did not vectorise.
    """
    if platform.machine().lower() not in ("x86_64", "amd64"):
        raise NotCounted(f"the assembly of {platform.machine()} is not known to benchmarks/assembly.py")
    uniform = len(inspect.signature(function.py_func).parameters) - 1
    signature = (_BLOCK,) + (types.float64,) * uniform
    function.compiled.compile(signature)
    outputs = sum(step.opname == "STORE_SUBSCR" for step in dis.get_instructions(function.py_func))
    # The function stands by itself, or where the compiler has inlined it, in the first: that for callers in Python.
    bodies = re.split(r"\.Lfunc_end\d+:", function.compiled.inspect_asm(signature))
    body = next(
        (text for text in bodies if re.search(rf'^"?{function.__name__}\.\w+"?:', text, re.MULTILINE)), bodies[0]
    )
    return count_text(body, outputs, function.__name__)


def count_text(body: str, outputs: int, name: str = "") -> Operations:
    """Count the operations in the assembly (AT&T syntax) of a loop that writes ``outputs`` rows."""
    text = Operations()
    written = 0
    lines = body.splitlines()
    begin = _loop_begin(lines)
    for number, match in enumerate(map(_INSTRUCTION.match, lines)):
        if match is None:
            continue
        mnemonic, operands = match.groups()
        registers = _REGISTER.findall(operands)
        arithmetic = _ARITHMETIC.match(mnemonic)
        if arithmetic and arithmetic["scalar"]:
            # What is the same in all lanes is computed once, before the loop.
            if number < begin:
                continue
            raise NotCounted(f"{name} is not vectorised throughout: {mnemonic} {operands.strip()}")
        if not registers or (not arithmetic and registers[-1] == "x"):
            continue
        if arithmetic:
            simple, fused, division, root = (arithmetic[k] is not None for k in ("simple", "fused", "division", "root"))
            text += Operations(simple, fused, division, root, vector_bits=_BITS[registers[-1]])
        if "(" in operands:
            is_store = _MASK.sub("", operands).rstrip().endswith(")")
            written += is_store and not _STACK.search(operands)
            text += Operations(loads=not is_store, stores=is_store)
    passes = math.ceil(written / outputs)
    if not passes or written < 0.8 * passes * outputs:
        raise NotCounted(f"{name} has {written} packed stores for {outputs} rows: its passes are not clear")
    return text * (1 / passes)


def _loop_begin(lines: list[str]) -> int:
    """The line of the first loop's label, to which a later line jumps back; 0 without a loop."""
    for number, match in enumerate(map(_LABEL.match, lines)):
        if match and any(_jumps_to(match[1], line) for line in lines[number:]):
            return number
    return 0


def _jumps_to(label: str, line: str) -> bool:
    return line.lstrip().startswith("j") and line.split()[-1] == label
