"""Figures of many landings, in one style for reports, documentation and notebooks.

Each function draws into axes it is given. `to_svg` makes text, lines and ground
follow the page's colours, so a figure reads on light and on dark.
"""

import io
import re
import textwrap
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.cm import ScalarMappable
from matplotlib.collections import PathCollection
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Rectangle
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter
from numpy.typing import NDArray

from studies.sampling import hashed

# Mid-tones of Okabe and Ito's hues: told apart with any colour vision, on white and on black.
PALETTE = ("#8a8f98", "#e08a1e", "#2f86c9", "#1a9e77", "#b06ab3", "#d9603b", "#7f9f2f")
INK, SOFT, LINE = "#24292f", "#6b7280", "#d5d9df"  # text, secondary text, grid
MEDIAN = "#d1344b"
_PAGE_COLOURS = {INK: "var(--ink)", SOFT: "var(--soft)", LINE: "var(--line)"}

STYLE: dict[Any, Any] = {
    "font.family": "sans-serif",
    "font.sans-serif": ["DejaVu Sans"],
    "font.size": 9.5,
    "text.color": INK,
    "axes.labelcolor": SOFT,
    "axes.edgecolor": LINE,
    "axes.titlesize": 9.5,
    "axes.titlecolor": INK,
    "axes.titlelocation": "left",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": LINE,
    "grid.linewidth": 0.7,
    "xtick.color": SOFT,
    "ytick.color": SOFT,
    "xtick.major.size": 0,
    "ytick.major.size": 0,
    "xtick.minor.size": 0,
    "ytick.minor.size": 0,
    "legend.frameon": False,
    "figure.facecolor": "none",
    "axes.facecolor": "none",
    "savefig.facecolor": "none",
    "svg.fonttype": "none",
    "svg.hashsalt": "plumbline",  # the same figure, the same bytes
}
TITLE_WIDTH = 30  # characters over a panel of touchdown points
DASHES = ("-", (0, (5, 1.5)), (0, (1.5, 1.2)), (0, (5, 1.2, 1.2, 1.2)))  # within one colour
HEAT = "YlOrRd"  # of maps, from little to much
HEAT_LIMITS = (2.0, 300.0)  # cm, of its colours
HEAT_DARK = 45.0  # cm, above which a colour asks for white text
RASTER_LIMIT = 1500  # points of a panel, above which they are drawn as one image


@dataclass
class Sample:
    """The landings of one condition, for drawing; arrays of shape (landings,)."""

    label: str
    colour: str
    values: NDArray[np.float64] = field(default_factory=lambda: np.empty(0))
    x: NDArray[np.float64] = field(default_factory=lambda: np.empty(0))
    y: NDArray[np.float64] = field(default_factory=lambda: np.empty(0))
    published: NDArray[np.float64] | None = None  # values of published trials
    published_x: NDArray[np.float64] | None = None
    published_y: NDArray[np.float64] | None = None


@contextmanager
def style() -> Iterator[None]:
    """The laboratory's matplotlib style."""
    with mpl.rc_context(STYLE):
        yield


def colours(groups: Sequence[str]) -> dict[str, str]:
    """A colour for each group, in the order they come."""
    names = list(dict.fromkeys(groups))
    return {name: PALETTE[index % len(PALETTE)] for index, name in enumerate(names)}


def boxes(axes: Axes, samples: Sequence[Sample], label: str, logarithmic: bool = False) -> None:
    """Box plots, one a line: median, quartiles, 5 to 95 %, the rest as dots.

    Published trials, where a sample has them, are diamonds below its box.
    """
    for line, sample in enumerate(samples):
        values = sample.values[np.isfinite(sample.values)]
        if len(values):
            _box(axes, -line, values, sample.colour)
        if sample.published is not None:
            axes.scatter(
                sample.published,
                np.full(len(sample.published), -line - 0.38),
                marker="D",
                s=11,
                facecolor="none",
                edgecolor=SOFT,
                linewidth=0.9,
                zorder=3,
            )
    axes.set_yticks(range(0, -len(samples), -1), [sample.label for sample in samples])
    axes.set_ylim(-len(samples) + 0.4, 0.6)
    axes.tick_params(axis="y", colors=INK)
    axes.grid(axis="y", visible=False)
    axes.spines["left"].set_visible(False)
    axes.set_xlabel(label)
    if logarithmic:
        _logarithmic(axes)
    else:
        axes.set_xlim(left=0.0)


def touchdowns(axes: Axes, sample: Sample, reach: float, unit: str) -> None:
    """Touchdown points around the pad's centre, with the circles of half and of 95 % of them.

    Points beyond `reach` are not drawn but counted.
    """
    distance = np.hypot(sample.x, sample.y)
    inside = distance <= reach
    points: PathCollection = axes.scatter(
        sample.x[inside],
        sample.y[inside],
        s=float(np.clip(2500.0 / max(len(sample.x), 1), 3.0, 16.0)),
        color=sample.colour,
        alpha=float(np.clip(60.0 / max(len(sample.x), 1) ** 0.7, 0.18, 0.8)),
        linewidth=0,
        zorder=2,
    )
    points.set_rasterized(int(inside.sum()) > RASTER_LIMIT)
    if sample.published_x is not None and sample.published_y is not None:
        axes.scatter(
            sample.published_x,
            sample.published_y,
            marker="D",
            s=13,
            facecolor="none",
            edgecolor=INK,
            linewidth=0.9,
            zorder=4,
        )
    if len(distance):
        for fraction, dashes in ((0.5, "-"), (0.95, (0, (4, 2)))):
            radius = float(np.quantile(distance, fraction))
            axes.add_patch(
                Circle((0, 0), radius, fill=False, color=MEDIAN, lw=1.1, ls=dashes, zorder=3)
            )
    axes.axhline(0.0, color=SOFT, lw=0.6, zorder=1)
    axes.axvline(0.0, color=SOFT, lw=0.6, zorder=1)
    axes.set(xlim=(-reach, reach), ylim=(-reach, reach), aspect="equal")
    axes.set_title(textwrap.fill(sample.label, TITLE_WIDTH))
    beyond = int((~inside).sum())
    text = f"{len(distance)} landings" + (f", {beyond} beyond" if beyond else "")
    axes.text(0.03, 0.03, text, transform=axes.transAxes, color=SOFT, fontsize=8)
    axes.locator_params(nbins=5)
    axes.tick_params(labelsize=8)
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.set_xlabel(f"east ({unit})", fontsize=8)


def exceedance(axes: Axes, samples: Sequence[Sample], label: str) -> None:
    """The share of landings farther out than each distance: tails, which boxes hide."""
    drawn: Counter[str] = Counter()
    for sample in samples:
        values = np.sort(sample.values[np.isfinite(sample.values)])
        if len(values):
            share = 1.0 - np.arange(len(values)) / len(values)
            axes.step(
                values,
                share,
                where="pre",
                color=sample.colour,
                ls=DASHES[drawn[sample.colour] % len(DASHES)],
                lw=1.5,
                label=sample.label,
            )
            drawn[sample.colour] += 1
    axes.set_yscale("log")
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{100 * value:g} %"))
    axes.yaxis.set_minor_formatter(NullFormatter())
    axes.set_ylabel("landings farther out")
    axes.set_xlabel(label)
    _logarithmic(axes)
    if drawn:
        axes.legend(fontsize=8, loc="lower left")


def curve(
    axes: Axes,
    at: Sequence[float],
    value: Sequence[float],
    low: Sequence[float],
    high: Sequence[float],
    label: str,
    colour: str,
    dashes: Any = "-",
) -> None:
    """A number over a grid, with the band of its interval; missing bounds leave gaps."""
    axes.fill_between(at, low, high, color=colour, alpha=0.14, lw=0)
    axes.plot(at, value, color=colour, lw=1.6, ls=dashes, marker="o", ms=3.5, label=label)


def heat_map(
    axes: Axes,
    values: NDArray[np.float64],
    texts: NDArray[Any],
    rows: Sequence[str],
    columns: Sequence[str],
) -> ScalarMappable:
    """Numbers as colours on one logarithmic scale for all maps, each with its text.

    Parameters
    ----------
    values : array of shape (rows, columns)
        In cm, say; nan leaves a field empty.
    texts : array of str, shape (rows, columns)
    rows, columns : sequence of str
        Names of the fields, the first row at the top.
    """
    shown = axes.imshow(
        np.ma.masked_invalid(values), cmap=HEAT, norm=LogNorm(*HEAT_LIMITS), aspect="auto"
    )
    for (i, j), text in np.ndenumerate(texts):
        if text:
            dark = np.isfinite(values[i, j]) and values[i, j] > HEAT_DARK
            colour = "#ffffff" if dark else "#15181d"
            axes.text(
                j, i, text, color=colour, fontsize=7.5, ha="center", va="center", linespacing=0.95
            )
    axes.set_xticks(range(len(columns)), columns)
    axes.set_yticks(range(len(rows)), rows)
    axes.tick_params(labelsize=8, colors=INK)
    axes.grid(visible=False)
    for spine in axes.spines.values():
        spine.set_visible(False)
    return shown


def plain_numbers(axis: Axis) -> None:
    """1, 2, 5, 10 on a logarithmic axis instead of powers."""
    axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_formatter(NullFormatter())


def figure(width: float, height: float) -> Figure:
    """An empty figure of the style, in inches, without pyplot's global state."""
    made = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasSVG(made)
    return made


def to_svg(drawn: Figure, description: str) -> str:
    """The figure as an SVG element to stand in a page that defines --ink, --soft and --line.

    Parameters
    ----------
    drawn : Figure
        Made by `figure`, inside `style()`.
    description : str
        What it shows, for those who cannot see it.
    """
    sink = io.StringIO()
    drawn.savefig(sink, format="svg", dpi=150, metadata={"Date": None, "Creator": None})
    text = sink.getvalue()
    text = text[text.index("<svg") :]
    for colour, variable in _PAGE_COLOURS.items():
        text = text.replace(colour, variable)
    text = re.sub(r"<metadata>.*?</metadata>", "", text, flags=re.DOTALL)
    text = re.sub(r'(<svg [^>]*?) height="[^"]*"', r"\1", text, count=1)
    text = re.sub(r'(<svg [^>]*?) width="([^"]*)"', r'\1 style="max-width:\2"', text, count=1)
    label = description.replace("&", "&amp;").replace("<", "&lt;").replace('"', "&quot;")
    text = text.replace("<svg ", f'<svg role="img" aria-label="{label}" ', 1)
    # Identifiers are unique within a figure only, and a page has several.
    prefix = f"f{hashed(label):x}-"
    text = re.sub(r'\bid="', f'id="{prefix}', text)
    text = re.sub(r'xlink:href="#', f'xlink:href="#{prefix}', text)
    return re.sub(r"url\(#", f"url(#{prefix}", text)


def _box(axes: Axes, line: int, values: NDArray[np.float64], colour: str) -> None:
    p5, q1, median, q3, p95 = np.quantile(values, [0.05, 0.25, 0.5, 0.75, 0.95])
    axes.plot([p5, q1], [line, line], color=colour, lw=1.2, solid_capstyle="butt")
    axes.plot([q3, p95], [line, line], color=colour, lw=1.2, solid_capstyle="butt")
    for end in (p5, p95):
        axes.plot([end, end], [line - 0.12, line + 0.12], color=colour, lw=1.2)
    axes.add_patch(Rectangle((q1, line - 0.22), q3 - q1, 0.44, facecolor=colour, alpha=0.35, lw=0))
    axes.add_patch(
        Rectangle((q1, line - 0.22), q3 - q1, 0.44, fill=False, edgecolor=colour, lw=1.2)
    )
    axes.plot([median, median], [line - 0.22, line + 0.22], color=MEDIAN, lw=2.0, zorder=3)
    outer = values[(values < p5) | (values > p95)]
    axes.scatter(
        outer,
        np.full(len(outer), line),
        s=6,
        color=colour,
        alpha=0.5,
        lw=0,
        rasterized=len(outer) > RASTER_LIMIT,
    )


def _logarithmic(axes: Axes) -> None:
    axes.set_xscale("log")
    plain_numbers(axes.xaxis)
