"""The documentation's pages of searches: the block between two marks, written anew.

python -m studies.search_pages out/falsify/* out/sensitivity/*
"""

import argparse
import json
import re
import shutil
from pathlib import Path
from typing import Any

from studies.ledger import write_durably

_BLOCK = re.compile(r"<!-- found -->.*?<!-- end -->", re.DOTALL)


def write(folders: list[Path], docs: Path) -> None:
    """Write the blocks of `falsification.md` and `sensitivity.md` from the folders of searches."""
    found = [folder for folder in folders if (folder / "finding.json").is_file()]
    if found:
        lines = ["| landing | spoiled by | flights | fresh seeds that miss | alone |"]
        lines += ["|---|---|---:|---:|---|"]
        lines += [_finding(_read(folder / "finding.json")) for folder in found]
        _replace(docs / "falsification.md", lines)
    ranked = [folder for folder in folders if (folder / "sensitivity.json").is_file()]
    blocks: list[str] = []
    for folder in ranked:
        said = _read(folder / "sensitivity.json")
        name = f"sensitivity-{said['scenario']}-{said['method']}.svg"
        (docs / "data").mkdir(exist_ok=True)
        shutil.copyfile(folder / "sensitivity.svg", docs / "data" / name)
        blocks += [
            f"## {said['scenario']}",
            "",
            f"{said['sentence']} ({said['flights']} flights, {said['method']})",
            "",
            f"![What matters to {said['scenario']}](data/{name})",
            "",
        ]
    if ranked:
        _replace(docs / "sensitivity.md", blocks)


def _finding(said: dict[str, Any]) -> str:
    names = ", ".join(said["vary"])
    if said["case"] is None:
        what = f"nothing of {names}" if said["complete"] else f"not finished: {names}"
    else:
        what = f"{said['case']}: {said['worst']} (severity {said['severity']:.2f})"
        if said["luckiest"] is not None:
            what += f"; from severity {said['luckiest']:.2f} on under some seeds"
    fresh = f"{said['other_seeds_missed']} of {said['other_seeds']}" if said["other_seeds"] else "–"
    spoiling = [entry["case"] for entry in said["alone"].values() if entry["spoils"]]
    harmless = [name for name, entry in said["alone"].items() if not entry["spoils"]]
    alone = []
    if spoiling:
        alone.append(f"spoils from: {'; '.join(spoiling)}")
    if harmless:
        alone.append(f"lands at the limit of: {', '.join(harmless)}")
    cells = [f"`{said['scenario']}`", what, str(said["flights"]), fresh, ". ".join(alone)]
    return f"| {' | '.join(cells)} |"


def _replace(page: Path, lines: list[str]) -> None:
    text = page.read_text(encoding="utf-8")
    block = "\n".join(["<!-- found -->", "", *lines, "", "<!-- end -->"])
    write_durably(page, _BLOCK.sub(lambda _: block, text).encode())


def _read(path: Path) -> dict[str, Any]:
    said: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    return said


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description="Write the pages of searches.")
    parser.add_argument("folders", nargs="+", type=Path, help="of searches")
    parser.add_argument("--docs", type=Path, default=Path("docs"))
    arguments = parser.parse_args()
    write(arguments.folders, arguments.docs)


if __name__ == "__main__":
    main()
