"""Picture of the function blocks of a running rack, and of how they are wired at present."""

from __future__ import annotations

from collections.abc import Mapping
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


def build_graph(segment: Segment) -> BlockGraph:
    """Return the graph of the first board of function blocks. Raises `Failure` without one."""
    for wiring in resolve(load_text(segment.config)).tasks:
        if issubclass(find_class(wiring.target, object), BlockExecutor):
            network = build_network(wiring.context)
            reading = open_observer(segment, f"{wiring.task}.status").peek()
            if reading.has_message:
                restore_network(network, reading.message)
            return _build_network_graph(wiring.task, network)
    raise Failure(f"--graph: no board of rack '{segment.rack}' consists of function blocks", 2)


def _build_network_graph(board: str, network: BlockNetwork) -> BlockGraph:
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


def save_graph(graph: BlockGraph, path: Path) -> None:
    """Save a graph, as PNG or SVG, depending on the suffix of the path."""
    with open_figure([path], 6.5, 1.4 * max(graph.rows.values()) + 1.6) as figure:
        _draw_graph(figure.add_subplot(), graph)


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
