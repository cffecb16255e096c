"""A campaign's source is found again among the commits."""

import subprocess
from pathlib import Path, PurePosixPath

import pytest

from studies import provenance


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    """Three commits, of which the last changes nothing that flies."""

    def git(*arguments: str) -> None:
        who = ("-c", "user.name=N", "-c", "user.email=n@example.org")
        subprocess.run(["git", *who, *arguments], cwd=tmp_path, check=True, capture_output=True)

    git("init")
    for package in provenance._SOURCE:
        (tmp_path / package).mkdir()
        (tmp_path / package / "part.py").write_text(f"name = {package!r}\n")
        (tmp_path / package / "part.pyc").write_text("not source")
    for change in ("scenarios/part.py", "systems/new/thing.yaml", "README"):
        (tmp_path / change).parent.mkdir(exist_ok=True)
        (tmp_path / change).write_text(f"{change}\n")
        git("add", "-A")
        git("commit", "-m", change)
    return tmp_path


def digest(root: Path, files: list[str]) -> str:
    named = ((PurePosixPath(file), (root / file).read_bytes()) for file in files)
    return provenance._digest(named)


def test_the_commit_that_flew(checkout: Path):
    log = subprocess.run(
        ["git", "log", "--format=%h"], cwd=checkout, check=True, capture_output=True, text=True
    )
    _readme, second, first = log.stdout.split()
    files = [f"{package}/part.py" for package in provenance._SOURCE]
    assert provenance.commit_of(digest(checkout, files), checkout) == first
    place = files.index("systems/part.py")
    files.insert(place, "systems/new/thing.yaml")
    assert provenance.commit_of(digest(checkout, files), checkout) == second
    assert provenance.commit_of("0" * 32, checkout) is None


def test_no_checkout_no_commit(tmp_path: Path, monkeypatch):
    monkeypatch.setenv("GIT_CEILING_DIRECTORIES", str(tmp_path.parent))
    assert provenance.commit_of("0" * 32, tmp_path) is None


def test_the_source_at_hand_is_the_one_of_its_commit():
    """Here and packed by git, the same files in the same order have the same digest."""
    commit = provenance.commit_of(provenance.provenance()["source"])
    try:
        status = subprocess.run(
            ["git", "status", "--porcelain", "--", *provenance._SOURCE],
            cwd=provenance._ROOT, check=True, capture_output=True, text=True,
        )  # fmt: skip
    except (OSError, subprocess.CalledProcessError):
        pytest.skip("no git checkout to compare the source with")
    assert status.stdout or commit
