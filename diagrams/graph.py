"""Graphs of diagrams: DOT always, SVG and PNG where Graphviz's `dot` is installed."""

import shutil
from pathlib import Path

import pydot
from pydrake.systems.framework import System

FORMATS = ("dot", "svg", "png")


class GraphError(RuntimeError):
    """A graph that cannot be drawn; its text is one sentence for the user."""


def wiring_dot(diagram: System, max_depth: int | None = None) -> str:
    """The wiring of a system as DOT text.

    Parameters
    ----------
    diagram : System
        Any Drake system.
    max_depth : int, optional
        How many levels of sub-diagrams to open; all if not given.
    """
    depth = 1_000 if max_depth is None else max_depth
    graph = _parse(diagram.GetGraphvizString(max_depth=depth))
    graph.set_graph_defaults(fontname="Helvetica")
    graph.set_node_defaults(fontname="Helvetica", fontsize="11")
    graph.set_edge_defaults(color="#0072b2aa", arrowsize="0.7")
    return graph.to_string()


def svg_of(dot: str) -> str | None:
    """DOT text as SVG, or None where Graphviz is not installed."""
    if shutil.which("dot") is None:
        return None
    return _draw(dot, "svg").decode("utf-8")


def write_graph(dot: str, path: Path) -> None:
    """Write DOT text as `.dot`, `.svg` or `.png`, by the suffix of `path`.

    Raises
    ------
    GraphError
        For another suffix, or if Graphviz is needed and absent.
    """
    suffix = path.suffix.removeprefix(".")
    if suffix not in FORMATS:
        raise GraphError(f"{path}: expected a name that ends in {', '.join(FORMATS)}")
    if suffix == "dot":
        path.write_text(dot, encoding="utf-8")
        return
    if shutil.which("dot") is None:
        raise GraphError(f"{path}: {suffix} needs Graphviz's dot, which is not installed; use .dot")
    path.write_bytes(_draw(dot, suffix))


def _parse(dot: str) -> pydot.Dot:
    graphs = pydot.graph_from_dot_data(dot)
    if not graphs:
        raise GraphError("not DOT text")
    return graphs[0]


def _draw(dot: str, drawing: str) -> bytes:
    return bytes(_parse(dot).create(format=drawing))
