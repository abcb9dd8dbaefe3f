"""Picture of the function blocks of a running rack, and of how they are wired at present."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from graphlib import TopologicalSorter
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from rack.backplane.mailbox.protocols import open_observer
from rack.backplane.segment import Segment
from rack.boards.config.loader import load_text
from rack.boards.config.resolved import resolve
from rack.levels.references import find_class
from rack.levels.systems.blocks.executor import BlockExecutor, build_network, restore_network
from rack.levels.systems.blocks.network import STOP, BlockNetwork
from rack.tools.console.answer import Failure
from rack.tools.console.pictures import open_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes

WIDTH = 3.0
HEIGHT = 2.0
"""Distances between the blocks of a row, and between rows, in units of the picture."""
BEND = 0.4
"""Bend of an arrow for each row that it passes."""


class BlockGraph(NamedTuple):
    """Blocks of a board and their connections.

    Attributes:
        board: The board.
        nodes: Text of each block.
        edges: Connections, as pairs of blocks, and their text.
        rows: Row of each block. Row 0 is at the top.
    """

    board: str
    nodes: Mapping[str, str]
    edges: Mapping[tuple[str, str], str]
    rows: Mapping[str, int]


def build_graphs(segment: Segment) -> list[BlockGraph]:
    """Return the graph of each board of function blocks. Raises `Failure` if there is none."""
    graphs = []
    for wiring in resolve(load_text(segment.config)).tasks:
        if issubclass(find_class(wiring.target, object), BlockExecutor):
            network = build_network(wiring.context)
            reading = open_observer(segment, f"{wiring.task}.status").peek()
            if reading.has_message:
                restore_network(network, reading.message)
            graphs.append(_build_graph(wiring.task, network))
    if not graphs:
        raise Failure(f"--graph: no board of rack '{segment.rack}' consists of function blocks", 2)
    return graphs


def _build_graph(board: str, network: BlockNetwork) -> BlockGraph:
    """Return the graph of the blocks of a board, with the newest value of each."""
    nodes = {"stop": "stop"}
    for name, block in network.blocks.items():
        value = f"{network.values[f'{name}.output']:.3g} {network.outputs[f'{name}.output'].unit}"
        nodes[name] = f"{name}\n{block.kind} {block.value or ''}\n{value.removesuffix(' 1')}"
    edges: dict[tuple[str, str], str] = {}
    above: dict[str, set[str]] = {name: set() for name in nodes}
    for target, source in network.wires.items():
        block_name, _, port = target.partition(".")
        name = source.removesuffix(".output")
        nodes.setdefault(name, f"{name}\n{network.outputs[source].unit}")
        before = edges.get((name, block_name))
        edges[name, block_name] = f"{before}, {port}" if before else port
        # A delay may close a cycle, which has no first row.
        if target == STOP or network.blocks[block_name].kind != "delay":
            above[block_name].add(name)
    rows: dict[str, int] = {}
    for name in TopologicalSorter(above).static_order():
        rows[name] = max((rows[other] + 1 for other in above.get(name, ())), default=0)
    return BlockGraph(board, nodes, edges, rows)


def save_graphs(graphs: Sequence[BlockGraph], path: Path) -> None:
    """Save graphs side by side, as PNG or SVG, depending on the suffix of the path."""
    height = max(max(graph.rows.values()) for graph in graphs)
    with open_figure([path], 6.5 * len(graphs), 1.4 * height + 1.6) as figure:
        panels = figure.subplots(1, len(graphs), squeeze=False)[0]
        for axes, graph in zip(panels, graphs, strict=True):
            _draw_graph(axes, graph)


def _draw_graph(axes: Axes, graph: BlockGraph) -> None:
    """Draw the blocks of a graph in their rows, and an arrow for each connection."""
    places: dict[str, tuple[float, float]] = {}
    for row in {*graph.rows.values()}:
        names = [name for name in graph.nodes if graph.rows[name] == row]
        for number, name in enumerate(names):
            places[name] = (number + 0.5 - 0.5 * len(names)) * WIDTH, -row * HEIGHT
    box = {"boxstyle": "round", "facecolor": "#DDEEFF", "edgecolor": "0.3"}
    for name, place in places.items():
        axes.annotate(graph.nodes[name], place, ha="center", va="center", bbox=box)
    plain = {"facecolor": "white", "edgecolor": "none", "pad": 0.5}
    for (start, end), text in graph.edges.items():
        (x0, y0), (x1, y1) = places[start], places[end]
        # A long arrow passes the blocks between its ends.
        bend = BEND * (abs(graph.rows[end] - graph.rows[start]) - 1)
        arrow = {
            "arrowstyle": "-|>",
            "color": "0.4",
            "shrinkA": 20,
            "shrinkB": 22,
            "connectionstyle": f"arc3,rad={bend}",
        }
        axes.annotate("", (x1, y1), (x0, y0), arrowprops=arrow)
        at = (x0 + x1 + bend * (y1 - y0)) / 2, (y0 + y1 - bend * (x1 - x0)) / 2
        axes.annotate(text, at, ha="center", va="center", fontsize=7, bbox=plain)
    columns = [x for x, _ in places.values()]
    axes.set_xlim(min(columns) - WIDTH / 2, max(columns) + WIDTH / 2)
    axes.set_ylim(-(max(graph.rows.values()) + 0.5) * HEIGHT, 0.5 * HEIGHT)
    axes.set_aspect("equal", anchor="N")
    axes.set_axis_off()
    axes.set_title(f"{graph.board}: blocks and wires")
