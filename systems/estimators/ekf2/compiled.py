"""How the kernels of the filter are compiled and kept on disk."""

import hashlib
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

from numba import njit

from systems.signals import measurement

_WITHOUT_KERNELS = ("__init__.py", "ekf2.py", "world_model.py")


@cache
def _sources() -> str:
    """A digest of everything that can change a kernel: this package and the message layouts."""
    package = sorted(Path(__file__).parent.glob("*.py"))
    files = [file for file in package if file.name not in _WITHOUT_KERNELS]
    files.append(Path(measurement.__file__))
    return hashlib.sha256(b"".join(file.read_bytes() for file in files)).hexdigest()


def kernel(function: Callable) -> Any:
    """Compile a function, cached on disk, with division as in C (x/0 is inf or NaN).

    Numba's cache looks at the file of the function itself only, so a kernel would go on
    with old versions of what it calls and with old indices of the layout. Here the whole
    package is its source.
    """
    dispatcher: Any = njit(cache=True, error_model="numpy")(function)
    dispatcher._cache._cache_file._source_stamp = _sources()
    return dispatcher
