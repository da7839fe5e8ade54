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

    @property
    def tree(self) -> ast.FunctionDef:
        """The definition."""
        if self._tree is None:
            code = self.function.__code__
            self._tree = _definitions(code.co_filename)[code.co_firstlineno]
        return self._tree

    @property
    def arguments(self) -> list[str]:
        """Names of the arguments."""
        return list(self.function.__code__.co_varnames[: self.function.__code__.co_argcount])

    def resolve(self, name: str) -> Any:
        """What a name that is not local stands for.

        Raises:
            NameError: for one that stands for nothing.
        """
        free = self.function.__code__.co_freevars
        if name in free:
            return (self.function.__closure__ or ())[free.index(name)].cell_contents
        if name not in self.function.__globals__ and not hasattr(builtins, name):
            raise NameError(f"name {name!r} is not defined in {self.function.__qualname__}")
        return self.function.__globals__.get(name, getattr(builtins, name, None))


@cache
def _definitions(file: str) -> Mapping[int, ast.FunctionDef]:
    """The definitions of a file, by their first lines."""
    nodes = ast.walk(ast.parse("".join(linecache.getlines(file))))
    found = [node for node in nodes if isinstance(node, ast.FunctionDef)]
    return {min([node.lineno, *(d.lineno for d in node.decorator_list)]): node for node in found}
