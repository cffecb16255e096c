"""What else decides a run's bits: the versions and the source that fly it."""

import hashlib
import importlib.util
import platform
from functools import cache
from importlib import metadata
from pathlib import Path

# The floors below the studies: whatever a run is made of.
_SOURCE = ("runs", "diagrams", "systems", "plants", "scenarios")
_LIBRARIES = ("drake", "numpy", "numba", "opencv-python-headless")


@cache
def provenance() -> dict[str, str]:
    """Versions of the libraries and a hash of the laboratory's own source and scenarios.

    Rows flown under different provenances may differ in their last bits, so a
    campaign does not mix them unasked.
    """
    return {
        "machine": platform.machine(),
        "python": platform.python_version(),
        **{library: _version(library) for library in _LIBRARIES},
        "source": _source_digest(),
    }


def scenario_digest(scenario: str) -> str:
    """The hash of a scenario's own file, empty for a scenario of the laboratory."""
    path = Path(scenario)
    return hashlib.blake2b(path.read_bytes(), digest_size=16).hexdigest() if path.is_file() else ""


def _version(library: str) -> str:
    try:
        return metadata.version(library)
    except metadata.PackageNotFoundError:
        return "absent"


def _source_digest() -> str:
    digest = hashlib.blake2b(digest_size=16)
    for package in _SOURCE:
        found = importlib.util.find_spec(package)
        for folder in (found.submodule_search_locations or []) if found else []:
            root = Path(folder)
            for file in sorted(root.rglob("*")):
                if file.suffix in (".py", ".yaml"):
                    digest.update(f"{package}/{file.relative_to(root).as_posix()}\0".encode())
                    digest.update(file.read_bytes())
    return digest.hexdigest()
