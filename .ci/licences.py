"""Print name, version and licence of every package that is installed here, from its metadata."""

from importlib.metadata import Distribution, distributions


def licence(package: Distribution) -> str:
    """The licence expression, else the licences of the classifiers, else the first line of the text."""
    metadata = package.metadata
    classes = [c.split(" :: ")[-1] for c in metadata.get_all("Classifier") or () if c.startswith("License :: ")]
    lines = (metadata.get("License-Expression") or "; ".join(classes) or metadata.get("License") or "").splitlines()
    return lines[0] if lines else "not stated"


if __name__ == "__main__":
    for package in sorted(distributions(), key=lambda one: one.metadata["Name"].lower()):
        print(f"{package.metadata['Name']:40} {package.version:16} {licence(package):.80}")
