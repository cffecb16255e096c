"""Graphs of diagrams: DOT always, SVG and PNG where Graphviz's `dot` is installed."""

import shutil
import subprocess
from collections.abc import Iterator, Sequence
from pathlib import Path

import pydot
from pydrake.systems.framework import System

FORMATS = ("dot", "svg", "png")
RECORDERS = ("record ", "log ")  # how diagrams.recording names what only records
_STYLE = """graph [fontname="Helvetica"];
node [fontname="Helvetica", fontsize=11];
edge [fontname="Helvetica", fontsize=10, color="#0072b2", arrowsize=0.7];
"""


class GraphError(RuntimeError):
    """A graph that cannot be drawn; its text is one sentence for the user."""


def wiring_dot(
    diagram: System, max_depth: int | None = None, hide: Sequence[str] = RECORDERS
) -> str:
    """The wiring of a system as DOT text.

    Parameters
    ----------
    diagram : System
        Any Drake system.
    max_depth : int, optional
        How many levels of sub-diagrams to open; all if not given.
    hide : sequence of str
        Systems whose names begin so are left out, with their connections.
    """
    depth = 1_000 if max_depth is None else max_depth
    graph = _parse(diagram.GetGraphvizString(max_depth=depth))
    parts = list(_parts(graph))
    hidden = {
        node.get_name()
        for part in parts
        for node in part.get_nodes()
        if any(f"name={prefix}" in str(node.get("label")) for prefix in hide)
    }
    for part in parts:
        for name in hidden:
            part.del_node(name)
        for edge in part.get_edges():
            ends = (str(edge.get_source()), str(edge.get_destination()))
            if hidden & {end.partition(":")[0] for end in ends}:
                part.del_edge(edge.get_source(), edge.get_destination())
    return graph.to_string().replace("{", f"{{\n{_STYLE}", 1)


def _parts(graph: pydot.Graph) -> Iterator[pydot.Graph]:
    """A graph and all its subgraphs, at every depth."""
    yield graph
    for subgraph in graph.get_subgraphs():
        yield from _parts(subgraph)


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
    command = ["dot", f"-T{drawing}"]
    try:
        return subprocess.run(command, input=dot.encode(), capture_output=True, check=True).stdout
    except subprocess.CalledProcessError as error:
        raise GraphError(f"dot: {error.stderr.decode().strip()}") from None
