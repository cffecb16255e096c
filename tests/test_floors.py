"""Imports only go down: the floors of the house."""

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]

# From the top floor down; a module may import from its own floor and from those below.
FLOORS = [
    ("plumbline",),
    ("studies",),
    ("runs",),
    ("diagrams",),
    ("systems",),
    ("plants",),
    (
        "systems.vision",
        "systems.signals",
        "systems.frames",
        "systems.runway_frames",
        "systems.configuration",
        "systems.schedule",
    ),
]
PACKAGES = {name.split(".")[0] for floor in FLOORS for name in floor}


def floor_of(module: str) -> int:
    """The floor of a module, counted from the top; the longest matching prefix decides."""
    matches = [
        (len(name), level)
        for level, floor in enumerate(FLOORS)
        for name in floor
        if module == name or module.startswith(name + ".")
    ]
    return max(matches)[1]


def modules() -> list[Path]:
    return sorted(file for package in sorted(PACKAGES) for file in (ROOT / package).rglob("*.py"))


def imported(file: Path) -> set[str]:
    tree = ast.parse(file.read_text())
    names = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{file}: import by absolute name"
            assert node.module
            names |= {node.module} | {f"{node.module}.{alias.name}" for alias in node.names}
    return {name for name in names if name.split(".")[0] in PACKAGES}


@pytest.mark.parametrize("file", modules(), ids=lambda file: str(file.relative_to(ROOT)))
def test_imports_go_down(file: Path):
    module = ".".join(file.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")
    level = floor_of(module)
    for name in imported(file):
        if name in PACKAGES:
            continue  # `from systems import frames` is judged by the longer name beside it
        assert floor_of(name) >= level, f"{module} imports {name}, which lies above it"
