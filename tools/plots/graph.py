"""Picture of a running rack as a graph: its boards, their rates and mailboxes, and its blocks."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from graphlib import TopologicalSorter
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from rack.backplane.mailbox.protocols import open_observer
from rack.backplane.segment import Segment
from rack.boards.config.loader import load_text
from rack.boards.config.resolved import resolve
from rack.boards.config.schema import RackConfig
from rack.levels.references import find_class
from rack.levels.systems.blocks.executor import BlockExecutor, build_network, restore_network
from rack.levels.systems.blocks.network import STOP, BlockNetwork
from rack.tools.console.pictures import open_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes

WIDTH = 3.0
HEIGHT = 2.0
"""Distances between the modules of a row, and between rows, in units of the picture."""
BEND = 0.15
"""Bend of an arrow, as a part of its length. It separates the two directions."""
LONG_BEND = 0.2
"""Bend for each row that an arrow spans, if it spans several."""


class Graph(NamedTuple):
    """Modules and their connections.

    Attributes:
        title: Title of the picture.
        nodes: Text of each module.
        edges: Connections, as pairs of modules, and their text.
        rows: Row of each module. Row 0 is at the top.
    """

    title: str
    nodes: Mapping[str, str]
    edges: Mapping[tuple[str, str], str]
    rows: Mapping[str, int]


def build_graphs(segment: Segment) -> list[Graph]:
    """Return the graph of a rack's boards, and one for each board of function blocks."""
    config = load_text(segment.config)
    graphs = [_build_board_graph(segment, config)]
    for wiring in resolve(config).tasks:
        if issubclass(find_class(wiring.target, object), BlockExecutor):
            network = build_network(wiring.context)
            reading = open_observer(segment, f"{wiring.task}.status").peek()
            if reading.has_message:
                restore_network(network, reading.message)
            graphs.append(_build_block_graph(wiring.task, network))
    return graphs


def _build_board_graph(segment: Segment, config: RackConfig) -> Graph:
    """Return the graph of the boards of a rack, with their rates and the mailboxes between them."""
    layout = segment.layout
    nodes = {
        task.name: f"{task.name}\n{1e9 / task.every / layout.clock_ns:g} Hz"
        for task in layout.tasks
    }
    nodes |= {host.name: f"{host.name}\nhost, no rate" for host in layout.hosts}
    ports = defaultdict(list)
    for mailbox in layout.mailboxes:
        for reader in {*mailbox.readers, mailbox.writer} - {mailbox.writer}:
            ports[mailbox.writer, reader].append(mailbox.name.partition(".")[2])
    edges = {pair: "\n".join(names) for pair, names in ports.items() if {*pair} <= {*nodes}}
    above = {name: {*getattr(config.board.get(name), "above", ())} for name in nodes}
    for name in nodes:
        table = config.board.get(name) or config.host.get(name)
        for other in getattr(table, "below", ()):
            above[other].add(name)
    rows = rank_nodes(above)
    in_hierarchy = {name for name in nodes if above[name]}.union(*above.values())
    for name in {*nodes} - in_hierarchy:
        # A board outside the hierarchy is drawn below the highest board that reads from it.
        rows[name] = 1 + min((rows[end] for start, end in edges if start == name), default=0)
    return Graph(f"{segment.rack}: boards and mailboxes", nodes, edges, rows)


def _build_block_graph(board: str, network: BlockNetwork) -> Graph:
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
    return Graph(f"{board}: blocks and wires", nodes, edges, rank_nodes(above))


def rank_nodes(above: Mapping[str, Iterable[str]]) -> dict[str, int]:
    """Return the length of the longest path to each node, by the nodes directly above it."""
    rows: dict[str, int] = {}
    for name in TopologicalSorter(above).static_order():
        rows[name] = max((rows[other] + 1 for other in above.get(name, ())), default=0)
    return rows


def save_graphs(graphs: Sequence[Graph], path: Path) -> None:
    """Save graphs side by side, as PNG or SVG, depending on the suffix of the path."""
    height = max(max(graph.rows.values()) for graph in graphs)
    size_in = 6.5 * len(graphs), 1.4 * height + 1.6
    with open_figure([path], *size_in) as figure:
        panels = figure.subplots(1, len(graphs), squeeze=False)[0]
        for axes, graph in zip(panels, graphs, strict=True):
            _draw_graph(axes, graph)


def _draw_graph(axes: Axes, graph: Graph) -> None:
    """Draw the modules of a graph in their rows, and an arrow for each pair that is connected."""
    places: dict[str, tuple[float, float]] = {}
    for row in range(max(graph.rows.values()) + 1):
        names = [name for name in graph.nodes if graph.rows[name] == row]
        centres = {name: _find_centre(name, graph, places) for name in names}
        for number, name in enumerate(sorted(names, key=lambda name: centres[name])):
            places[name] = (number + 0.5 - 0.5 * len(names)) * WIDTH, -row * HEIGHT
    for (start, end), text in graph.edges.items():
        (x0, y0), (x1, y1) = places[start], places[end]
        span = abs(graph.rows[end] - graph.rows[start])
        # A long arrow passes the modules between its ends.
        bend = BEND if span < 2 else LONG_BEND * span
        axes.annotate(
            "",
            (x1, y1),
            (x0, y0),
            arrowprops={
                "arrowstyle": "-|>",
                "color": "0.4",
                "shrinkA": 20,
                "shrinkB": 20,
                "connectionstyle": f"arc3,rad={bend}",
            },
        )
        # Nearer to its start, so that it misses the text of the opposite direction.
        at = (
            0.6 * x0 + 0.4 * x1 + 0.5 * bend * (y1 - y0),
            0.6 * y0 + 0.4 * y1 - 0.5 * bend * (x1 - x0),
        )
        plain = {"facecolor": "white", "edgecolor": "none", "pad": 0.5}
        axes.annotate(text, at, ha="center", va="center", fontsize=7, bbox=plain)
    for name, place in places.items():
        box = {"boxstyle": "round", "facecolor": "#DDEEFF", "edgecolor": "0.3"}
        axes.annotate(graph.nodes[name], place, ha="center", va="center", bbox=box)
    columns = [x for x, _ in places.values()]
    axes.set_xlim(min(columns) - WIDTH / 2, max(columns) + WIDTH / 2)
    axes.set_ylim(-(max(graph.rows.values()) + 0.5) * HEIGHT, 0.5 * HEIGHT)
    axes.set_aspect("equal", anchor="N")
    axes.set_axis_off()
    axes.set_title(graph.title)


def _find_centre(name: str, graph: Graph, places: Mapping[str, tuple[float, float]]) -> float:
    """Return the mean horizontal place of the connected modules that are placed already."""
    others = [start if end == name else end for start, end in graph.edges if name in (start, end)]
    placed = [places[other][0] for other in others if other in places]
    return sum(placed) / len(placed) if placed else 0.0
