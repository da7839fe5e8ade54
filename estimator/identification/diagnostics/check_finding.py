"""`CheckFinding`: what a check of an identification found."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class CheckFinding:
    """What a check found.

    Attributes:
        name: of the check, such as ``"delay"``.
        message: what was found, and what to do, in plain words.
        parameters: those that it is about, where it is about some.
    """

    name: str
    message: str
    parameters: tuple[str, ...] = ()

    def __str__(self) -> str:
        return f"{self.name}: {self.message}"
