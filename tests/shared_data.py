"""Where tests find the reference data that lies beside the repository."""

import os
from pathlib import Path

import pytest

_DEFAULT = Path(__file__).resolve().parents[2] / "shared"


def shared(path: str) -> Path:
    """The path of a reference file; skips the calling test where it is absent."""
    root = Path(os.environ.get("PLUMBLINE_SHARED", _DEFAULT))
    file = root / path
    if not file.exists():
        pytest.skip(f"reference data {path} is not in {root} (set PLUMBLINE_SHARED)")
    return file
