"""`CheckFinding`: a finding of a check, with its message and the parameters that it concerns."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class CheckFinding:
    """A finding of a check.

    Attributes:
        name: name of the check, such as ``"delay"``.
        message: the finding and the remedy, in plain words.
        parameters: the parameters that it concerns, if any.
    """

    name: str
    message: str
    parameters: tuple[str, ...] = ()

    def __str__(self) -> str:
        return f"{self.name}: {self.message}"
