"""Print name, version and licence of every package that is installed here, as its own metadata tells it."""

from importlib.metadata import Distribution, distributions


def licence(package: Distribution) -> str:
    """The licence expression; or the classifiers'; or the first line of the text."""
    told = package.metadata
    classes = [c.split(" :: ")[-1] for c in told.get_all("Classifier") or () if c.startswith("License :: ")]
    lines = (told.get("License-Expression") or "; ".join(classes) or told.get("License") or "").splitlines()
    return lines[0] if lines else "not told"


if __name__ == "__main__":
    for package in sorted(distributions(), key=lambda one: one.metadata["Name"].lower()):
        print(f"{package.metadata['Name']:40} {package.version:16} {licence(package):.80}")
