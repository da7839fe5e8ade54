"""The syntax tree of a Python function, and the objects that its names refer to."""

from __future__ import annotations

import ast
import builtins
import linecache
from collections.abc import Callable, Mapping
from functools import cache, cached_property
from typing import Any


class FunctionSource:
    """A function's definition, and the objects of its names.

    Args:
        function: the Python function.
        text: its source; None to read the file.
    """

    def __init__(self, function: Callable[..., Any], text: str | None = None) -> None:
        self.function = function
        self.name = function.__qualname__
        if text is None:
            # The text is read now: the file may change before compilation.
            linecache.checkcache(function.__code__.co_filename)
            text = "".join(linecache.getlines(function.__code__.co_filename))
        self._text = text

    @cached_property
    def tree(self) -> ast.FunctionDef:
        """The definition.

        Raises:
            TypeError: if the function's file does not have it.
        """
        code = self.function.__code__
        tree = _functions_by_line(self._text).get(code.co_firstlineno)
        if tree is None or tree.name != self.function.__name__:
            raise TypeError(f"{self.name} is not defined in {code.co_filename}; use scalar_jit_from_source")
        return tree

    @property
    def arguments(self) -> list[str]:
        """Names of the arguments."""
        return list(self.function.__code__.co_varnames[: self.function.__code__.co_argcount])

    def resolve(self, name: str) -> Any:
        """The object of a name that is not local.

        Raises:
            NameError: for an undefined name, or one that is assigned in a loop only.
        """
        free = self.function.__code__.co_freevars
        if name in free:
            return (self.function.__closure__ or ())[free.index(name)].cell_contents
        if name in self.function.__code__.co_varnames or not (
            name in self.function.__globals__ or hasattr(builtins, name)
        ):
            raise NameError(f"name {name!r} is not defined in {self.name}; assign it before, and not in a loop")
        return self.function.__globals__.get(name, getattr(builtins, name, None))


@cache
def _functions_by_line(text: str) -> Mapping[int, ast.FunctionDef]:
    """The definitions in a file's text, by first line."""
    nodes = ast.walk(ast.parse(text))
    found = [node for node in nodes if isinstance(node, ast.FunctionDef)]
    return {min([node.lineno, *(d.lineno for d in node.decorator_list)]): node for node in found}
