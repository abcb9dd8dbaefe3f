"""Every field of every type that the racks of a cell import, at its extremes, into the boards that
read it: none ends."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from rack.boards.config import CONFIGS, load, resolve
from rack.boards.config.schema import RackConfig
from rack.levels.messages import Error
from rack.levels.operator import Goal
from rack.levels.systems.cell.coordinator import CellProgram
from rack.levels.systems.cell.messages import (
    CELL_ORDER,
    CELL_REPORT,
    OrderAction,
    OrderVerb,
    Response,
)
from rack.levels.systems.cell.shared_bodies import SHARED_BODIES
from rack.tools.viewer.window import free_port
from tests.boards.lan.extreme_levels import Case, cases
from tests.boards.lan.racks import Ended, run_together

pytestmark = pytest.mark.thorough

FOLDER = CONFIGS / "cell"
ORDER = "rack.levels.systems.cell.messages:CELL_ORDER"
REPORT = "rack.levels.systems.cell.messages:CELL_REPORT"
BODIES = "rack.levels.systems.cell.shared_bodies:SHARED_BODIES"
POSE = {
    "action": OrderAction.GOTO,
    "goal": Goal.POSE,
    "position": (0.45, -0.3, 0.7),
    "quaternion": (0, 1, 0, 0),
}
ACTIONS: Sequence[Mapping[str, Any]] = (
    POSE,
    {"action": OrderAction.GOTO, "goal": Goal.JOINTS, "count": 6, "joints": 0.1},
    {
        "action": OrderAction.TRANSFER,
        "object": b"part",
        "position": (0.62, 0.0, 0.475),
        "lift": 0.1,
        "turned": 1,
    },
)
PLANNED = 14
"""Cycles at 10 Hz in which an order is rehearsed."""


class Sender(NamedTuple):
    """A rack that stands in for one: what it sends in one mailbox, by cycles and case."""

    rack: str
    mailbox: str
    type: str
    rate_hz: int
    rows: Sequence[tuple[int, Case]]

    @property
    def refused(self) -> int:
        """How many of its messages no rack may take."""
        return sum(cycles for cycles, (_, _, is_permitted) in self.rows if not is_permitted)

    def text(self, peer: str, listen: int) -> str:
        """Return its config; it connects to the port at which the peer listens."""
        board, port = self.mailbox.split(".")
        # The plain one last: it is sent until all have ended.
        rows = [[cycles, message.hex()] for cycles, (_, message, _) in (*self.rows, self.rows[0])]
        return f"""
format = 2
name = "{self.rack}"
python_path = ["{Path(__file__).parents[3]}"]

[clock]
period_ms = 10.0
mode = "lockstep"

[adapter.lan]
slot = 2
rate_hz = 50
insecure = true
connect = ["tcp/127.0.0.1:{listen}"]
peers = ["{peer}"]

[adapter.lan.export.{board}]
from = "{self.mailbox}"
rate_hz = {self.rate_hz}

[board.{board}]
slot = 3
rate_hz = {self.rate_hz}
executor = "tests.boards.lan.extreme_levels:Extremes"
params = {{ port = "{port}", type = "{self.type}", cases = {json.dumps(rows)} }}
"""


def real(file: str, name: str, folder: Path, listen: int) -> RackConfig:
    """Return the config of a shipped rack under a name of its own, where `cell` stands in its
    name."""
    for path in FOLDER.glob("*.toml"):
        text = re.sub(r'"cell(?=["/-])', f'"{name}', path.read_text().replace('"../', '"'))
        (folder / path.name).write_text(text)
    # In lockstep, with a network of nobody but those that connect to it.
    endpoint = f'listen=["tcp/127.0.0.1:{listen}"]'
    own = (endpoint, "insecure=true", "connect=[]", "launch=[]", "estop_from=[]")
    lan = (f"adapter.lan.{setting}" for setting in own)
    return load(folder / f"{file}.toml", ["clock.mode=lockstep", *lan])


def run(rack: RackConfig, listen: int, senders: Sequence[Sender], folder: Path) -> Ended:
    """Run a rack with those that stand in for the others, until they have sent everything."""
    found = [rack]
    for k, sender in enumerate(senders):
        path = folder / f"sender-{k}.toml"
        path.write_text(sender.text(rack.name, listen))
        found.append(load(path))
    lasts = [sum(cycles for cycles, _ in sender.rows) / sender.rate_hz for sender in senders]
    return run_together(found, [max(lasts) + 1.0] * len(found))[0]


def check(found: Ended, counts: Mapping[str, int]) -> None:
    """All boards live, no stop is latched, and exactly what no type permits is refused, import by
    import."""
    assert not found.outcome.faults, found.texts
    assert not [event.text for event in found.events if event.kind in ("died", "detection")], (
        found.texts
    )
    imports = {port: found.last["lan.status"][f"import_{port}"] for port in counts}
    assert {port: int(entry["refused"]) for port, entry in imports.items()} == counts
    assert all(entry["taken"] > 0 for entry in imports.values())


def test_all_types_that_the_racks_of_a_cell_import_are_tried() -> None:
    texts = [path.read_text() for path in FOLDER.rglob("*.toml")]
    found = [
        re.findall(r"\[adapter\.lan\.import\.[^]]*\][^[]*?\ntype = \"(.*)\"", text)
        for text in texts
    ]
    assert {name for names in found for name in names} == {ORDER, REPORT, BODIES}


def orders_and_bodies(
    name: str, orders: Sequence[tuple[int, Case]], bodies: Sequence[tuple[int, Case]]
) -> list[Sender]:
    """Return the racks that stand in for those from which the PUMA imports."""
    plain = [(1, next(cases(CELL_ORDER, {})))], [(1, next(cases(SHARED_BODIES, {})))]
    return [
        Sender(name, "task.order_puma", ORDER, 10, orders or plain[0]),
        Sender(f"{name}-k1607", "servo.shared", BODIES, 50, bodies or plain[1]),
    ]


@pytest.mark.slow
@pytest.mark.parametrize("action", ACTIONS)
def test_no_extreme_of_an_order_ends_a_board_of_an_arm(
    action: Mapping[str, Any], rack_name: str, tmp_path: Path
) -> None:
    orders = []
    for case in cases(CELL_ORDER, {"id": 1, "program": 7, "what": OrderVerb.ASK, **action}):
        is_of_action = case[0].split()[0] in action
        if is_of_action or action is POSE:
            orders.append((PLANNED if is_of_action and case[2] else 1, case))
    listen, senders = free_port(), orders_and_bodies(rack_name, orders, ())
    found = run(real("puma", rack_name, tmp_path, listen), listen, senders, tmp_path)
    check(found, {"orders": senders[0].refused, "shared": 0})


@pytest.mark.slow
def test_no_extreme_of_a_shared_body_ends_a_board_of_an_arm(rack_name: str, tmp_path: Path) -> None:
    body = {
        "name": b"part",
        "claim": 3,
        "owner": b"other",
        "position": (0.6, 0.1, 0.475),
        "quaternion": (1, 0, 0, 0),
    }
    found = cases(SHARED_BODIES, {"rack": b"other", "bodies": body})
    first = ("plain", "bodies.position", "bodies.quaternion")
    # At 0 the part is in the pedestal, an unintended contact. Last: greater claims, after which
    # this one is not heard.
    tried = sorted(
        (one for one in found if one[0] != "bodies.position = 0.0"),
        key=lambda one: one[0].split()[0] not in first,
    )
    listen, senders = free_port(), orders_and_bodies(rack_name, (), [(5, one) for one in tried])
    ended = run(real("puma", rack_name, tmp_path, listen), listen, senders, tmp_path)
    check(ended, {"orders": 0, "shared": senders[1].refused})


@pytest.mark.slow
def test_no_extreme_of_a_report_ends_a_coordinator(rack_name: str, tmp_path: Path) -> None:
    listen = free_port()
    cell = real("cell", rack_name, tmp_path, listen)
    checksum = CellProgram.model_validate(resolve(cell).config.task).checksum
    answer = {"program": checksum, "echo": 1000}
    rows = [
        *cases(CELL_REPORT, answer),
        *cases(CELL_REPORT, {**answer, "response": Response.DOING, "moves": 2}),
    ]
    # Last: a refusal that is permitted ends the program.
    refusal = {**answer, "response": Response.REFUSED, "error": Error.NO_PATH, "reason": b"no"}
    rows += sorted(cases(CELL_REPORT, refusal), key=lambda case: case[0] != "error = 65535")
    senders = [
        Sender(f"{rack_name}-{arm}", "task.report", REPORT, 10, [(2, case) for case in rows])
        for arm in ("puma", "k1607")
    ]
    found = run(cell, listen, senders, tmp_path)
    refused = senders[0].refused
    check(found, {"puma": refused, "k1607": refused})
