"""What else decides a run's bits: the versions and the source that fly it."""

import hashlib
import importlib.util
import io
import platform
import subprocess
import tarfile
from collections.abc import Iterable
from functools import cache
from importlib import metadata
from pathlib import Path, PurePosixPath

# The floors below the studies: whatever a run is made of.
_SOURCE = ("runs", "diagrams", "systems", "plants", "scenarios")
_ROOT = Path(__file__).resolve().parents[1]
_KINDS = (".py", ".yaml")
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


def commit_of(source: str, root: Path = _ROOT) -> str | None:
    """The latest commit under `root` whose source has this digest, abbreviated; None if none has.

    None too where there is no git, or no checkout.
    """

    def git(*arguments: str) -> bytes:
        return subprocess.run(["git", *arguments], cwd=root, check=True, capture_output=True).stdout

    try:
        commits = git("log", "--format=%h", "--", *_SOURCE).decode().split()
        for commit in commits:
            packed = io.BytesIO(git("archive", "--format=tar", commit, "--", *_SOURCE))
            with tarfile.open(fileobj=packed) as archive:
                names = [PurePosixPath(entry.name) for entry in archive if entry.isfile()]
                files = (
                    (name, handle.read())
                    for package in _SOURCE
                    for name in sorted(names)
                    if name.parts[0] == package and (handle := archive.extractfile(str(name)))
                )
                if _digest(files) == source:
                    return commit
    except (OSError, subprocess.CalledProcessError):
        return None
    return None


def _source_digest() -> str:
    return _digest(
        (PurePosixPath(package) / file.relative_to(root).as_posix(), file.read_bytes())
        for package in _SOURCE
        if (found := importlib.util.find_spec(package))
        for root in map(Path, found.submodule_search_locations or [])
        for file in sorted(root.rglob("*"))
        if file.suffix in _KINDS
    )


def _digest(files: Iterable[tuple[PurePosixPath, bytes]]) -> str:
    digest = hashlib.blake2b(digest_size=16)
    for name, content in files:
        if name.suffix in _KINDS:
            digest.update(f"{name}\0".encode())
            digest.update(content)
    return digest.hexdigest()
