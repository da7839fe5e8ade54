"""Detects whether another distribution has written a package of the same name over one of this project's packages.

``agents`` and ``estimator`` are common names: ``pip install openai-agents`` replaces ``agents/__init__.py`` silently,
and errors then arise in the other package.
"""

from __future__ import annotations

from importlib.machinery import PathFinder
from importlib.metadata import packages_distributions
from pathlib import Path

#: Text that the ``__init__.py`` of each of our packages contains.
PACKAGE_MARK = "lazy_loader.attach_stub(__name__, __file__)"


def overwrite_message(package: str, install_folder: Path) -> str | None:
    """The remedy for a package of ours that another distribution has overwritten; None where none has.

    A package of this name that comes first on the path, such as the user's folder ``agents``, overwrites nothing.

    Args:
        package: name of the package.
        install_folder: folder in which our packages are installed.
    """
    spec = PathFinder.find_spec(package)
    places = list(spec.submodule_search_locations or []) if spec is not None else []
    if spec is None or str(install_folder / package) not in places:
        return None
    if spec.origin is not None and PACKAGE_MARK in Path(spec.origin).read_text(encoding="utf-8"):
        return None
    others = [name for name in packages_distributions().get(package, []) if name != "duffing-env"]
    return (
        f"{install_folder / package} is no longer duffing-env's: {' and '.join(others) or 'another distribution'} has "
        f"written a package {package!r} over it. Uninstall that, or give duffing-env an environment of its own; then "
        "run: pip install --force-reinstall --no-deps duffing-env"
    )
