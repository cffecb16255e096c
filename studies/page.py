"""The report of a search, once as a page of HTML and once as Markdown."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from importlib import resources
from pathlib import Path

import jinja2
from markupsafe import Markup
from matplotlib.figure import Figure

from studies import figures
from studies.ledger import write_durably


@dataclass
class Section:
    """A heading with what belongs under it; all but the title may be empty."""

    title: str
    text: str = ""
    code: str = ""  # commands or a file
    head: list[str] = field(default_factory=list)  # of a table
    rows: list[list[str]] = field(default_factory=list)
    figure: Figure | None = None
    name: str = ""  # of the figure's file
    svg: Markup | str = ""  # of the page; drawn from `figure`


def write_page(folder: Path, title: str, sentence: str, sections: Sequence[Section]) -> None:
    """Write `report.html`, `report.md` and the figures beside it into a folder.

    Figures are those of `studies.figures`, drawn within its style.
    """
    for section in sections:
        if section.figure is not None:
            section.svg = Markup(figures.to_svg(section.figure, section.title))
            section.figure.savefig(
                folder / f"{section.name}.svg",
                facecolor="white",
                metadata={"Date": None, "Creator": None},
            )
    template = (resources.files("studies") / "page.html.jinja").read_text(encoding="utf-8")
    environment = jinja2.Environment(
        autoescape=True, trim_blocks=True, lstrip_blocks=True, undefined=jinja2.StrictUndefined
    )
    html = environment.from_string(template).render(
        title=title, sentence=sentence, sections=sections
    )
    write_durably(folder / "report.html", html.encode())
    write_durably(folder / "report.md", markdown(title, sentence, sections).encode())


def markdown(title: str, sentence: str, sections: Sequence[Section]) -> str:
    """The report as Markdown; figures are files beside it."""
    blocks = [f"# {title}", f"**{sentence}**"]
    for section in sections:
        blocks.append(f"## {section.title}")
        if section.text:
            blocks.append(section.text)
        if section.code:
            blocks.append(f"```\n{section.code.rstrip()}\n```")
        if section.name:
            blocks.append(f"![{section.title}]({section.name}.svg)")
        if section.rows:
            lines = [section.head, ["---"] * len(section.head), *section.rows]
            blocks.append("\n".join(f"| {' | '.join(line)} |" for line in lines))
    return "\n\n".join(blocks) + "\n"
