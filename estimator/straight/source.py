"""The definition of a function, as Python's syntax tree."""

from __future__ import annotations

import ast
import builtins
import linecache
from collections.abc import Callable, Mapping
from functools import cache
from typing import Any


class Source:
    """A function's definition, and what its names stand for.

    Args:
        function: as Python defined it.
        tree: its definition, where its file does not hold it.
    """

    def __init__(self, function: Callable[..., Any], tree: ast.FunctionDef | None = None) -> None:
        self.function, self._tree = function, tree
        self.name = function.__qualname__
        if tree is None:
            # The text as it is now, and not when it is compiled: the file may have changed then.
            linecache.checkcache(function.__code__.co_filename)
            self._text = "".join(linecache.getlines(function.__code__.co_filename))

    @property
    def tree(self) -> ast.FunctionDef:
        """The definition.

        Raises:
            TypeError: where the function's file does not hold it.
        """
        if self._tree is None:
            code = self.function.__code__
            self._tree = _definitions(self._text).get(code.co_firstlineno)
            if self._tree is None or self._tree.name != self.function.__name__:
                raise TypeError(f"{self.name} is not defined in {code.co_filename}; use straight_within its source")
        return self._tree

    @property
    def arguments(self) -> list[str]:
        """Names of the arguments."""
        return list(self.function.__code__.co_varnames[: self.function.__code__.co_argcount])

    def resolve(self, name: str) -> Any:
        """What a name that is not local stands for.

        Raises:
            NameError: for one that stands for nothing, or for what a loop has assigned and forgotten.
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
def _definitions(text: str) -> Mapping[int, ast.FunctionDef]:
    """The definitions in a file's text, by their first lines."""
    nodes = ast.walk(ast.parse(text))
    found = [node for node in nodes if isinstance(node, ast.FunctionDef)]
    return {min([node.lineno, *(d.lineno for d in node.decorator_list)]): node for node in found}
