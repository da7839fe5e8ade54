"""Results as JSON files, with the versions of Python and the packages that made them."""

from __future__ import annotations

import json
import platform
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from estimator.support.file_io import write_atomically


def write_json(path: Path, content: Any) -> None:
    """Write a JSON file in one piece, with null for every number that is not finite.

    Raises:
        OSError: where the file cannot be written.
    """
    write_atomically(
        path, json.dumps(replace_non_finite(content), indent=2, ensure_ascii=False, allow_nan=False) + "\n"
    )


def replace_non_finite(content: Any) -> Any:
    """The content with None for every number that is not finite, which JSON cannot hold."""
    if isinstance(content, dict):
        return {key: replace_non_finite(value) for key, value in content.items()}
    if isinstance(content, list | tuple):
        return [replace_non_finite(value) for value in content]
    return None if isinstance(content, float) and not np.isfinite(content) else content


#: Packages on which the numbers of a result depend.
VERSIONED_PACKAGES = ("duffing-env", "gymnasium", "numpy", "numba", "scipy")


def package_versions(*packages: str) -> dict[str, str]:
    """Versions of Python, of `VERSIONED_PACKAGES`, and of these packages."""
    return {"python": platform.python_version(), **{name: version(name) for name in (*VERSIONED_PACKAGES, *packages)}}
