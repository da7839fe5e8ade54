"""Whether our packages are ours: another distribution may have written one of the same name over them.

``agents`` and ``estimator`` are common names. ``pip install openai-agents`` replaces ``agents/__init__.py`` without a
word, and what then fails, fails in theirs.
"""

from __future__ import annotations

from importlib.machinery import PathFinder
from importlib.metadata import packages_distributions
from pathlib import Path

#: What the first file of each of our packages holds.
PACKAGE_MARK = "lazy_loader.attach_stub(__name__, __file__)"


def overwrite_message(package: str, install_folder: Path) -> str | None:
    """What to do about a package of ours that another distribution has overwritten; None where it has not.

    A package of this name that comes first on the path, such as a folder ``agents`` of the user's own, overwrites
    nothing.

    Args:
        package: its name.
        install_folder: the folder that our packages are installed in.
    """
    spec = PathFinder.find_spec(package)
    places = list(spec.submodule_search_locations or []) if spec is not None else []
    if spec is None or str(install_folder / package) not in places:
        return None
    if spec.origin is not None and PACKAGE_MARK in Path(spec.origin).read_text(encoding="utf-8"):
        return None
    others = [name for name in packages_distributions().get(package, []) if name != "duffing-env"]
    return (
        f"{install_folder / package} is no longer duffing-env's: {' and '.join(others) or 'another distribution'} has written "
        f"a package {package!r} over it. Uninstall that, or give duffing-env an environment of its own; then run: "
        "pip install --force-reinstall --no-deps duffing-env"
    )
