"""Every field of every type that shipped racks import, at its extremes, into the boards that read
it: none ends."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from itertools import count
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest

from rack.backplane.message import State
from rack.boards.config import CONFIGS, load, resolve
from rack.boards.config.cell import build_rack_cell, compute_cell_sizes
from rack.boards.config.schema import RackConfig
from rack.levels.messages import Error
from rack.levels.operator import Goal
from rack.levels.robot.dynamics import Dynamics
from rack.levels.systems.coordination.coordinator import CellProgram
from rack.levels.systems.coordination.messages import (
    CellOrder,
    CellReport,
    OrderAction,
    OrderVerb,
    Response,
)
from rack.levels.systems.coordination.shared_bodies import SharedBodies
from rack.tools.viewer.window import find_free_port
from tests.boards.lan.extreme_levels import Case, cases, message_class
from tests.boards.lan.racks import Ended, run_together
from tests.test_brown_network import configs

pytestmark = pytest.mark.thorough

COORDINATION = "rack.levels.systems.coordination"
ORDER, REPORT = f"{COORDINATION}.messages:CellOrder", f"{COORDINATION}.messages:CellReport"
BODIES = f"{COORDINATION}.shared_bodies:SharedBodies"
JOINT_BOARDS = "rack.levels.systems.joint_boards"
BROWN = {
    "rack.levels.messages:TaskStatus",
    "rack.levels.messages:WorldState",
    f"{JOINT_BOARDS}.messages:JointReference",
    f"{JOINT_BOARDS}.messages:JointStatus",
    f"{JOINT_BOARDS}.modified_from_afar:Modifications",
    f"{JOINT_BOARDS}.modified_from_afar:ModifiedAnswer",
}
"""What the racks of brown send each other: all that they import is tried."""
POSE = {
    "action": OrderAction.GOTO,
    "goal": Goal.POSE,
    "position": (0.45, -0.3, 0.7),
    "quaternion": (0, 1, 0, 0),
}
WRONG_NAMES = b"shoulder.none elbow. wrist.notch x.y wrist"
"""Modifications that no board has."""
Bases = Callable[[str, RackConfig], Iterator[Mapping[str, Any]]]
ACTIONS: Sequence[Mapping[str, Any]] = (
    POSE,
    {**POSE, "goal": Goal.DIRECTION, "direction": (0, 0, -1), "by": 500.0},
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


class Stream(NamedTuple):
    """What a rack that stands in for another sends in one mailbox: cycles and case."""

    mailbox: str
    type: str
    rate_hz: int
    rows: Sequence[tuple[int, Case]]

    @property
    def refused(self) -> int:
        """How many of its messages no rack may take."""
        return sum(cycles for cycles, (_, _, is_permitted) in self.rows if not is_permitted)

    def text(self, slot: int) -> str:
        board, port = self.mailbox.split(".")
        # The plain one last: it is sent until all have ended.
        rows = [[cycles, message.hex()] for cycles, (_, message, _) in (*self.rows, self.rows[0])]
        return f"""
[board.{board}]
slot = {slot}
rate_hz = {self.rate_hz}
executor = "tests.boards.lan.extreme_levels:Extremes"
params = {{ port = "{port}", type = "{self.type}", cases = {json.dumps(rows)} }}

[adapter.lan.export.{board}]
from = "{self.mailbox}"
rate_hz = {self.rate_hz}
"""


class Sender(NamedTuple):
    """A rack that stands in for one. `extends`: the config whose arm and scene its types need."""

    rack: str
    streams: Sequence[Stream]
    extends: Sequence[str] = ()
    rate_hz: float = 50.0  # of its adapter: lockstep needs that of the other

    @property
    def seconds(self) -> float:
        """Simulated time of all that it sends."""
        return max(sum(cycles for cycles, _ in one.rows) / one.rate_hz for one in self.streams)

    def text(self, port: int, peer: str, connect: Sequence[str]) -> str:
        return f"""
format = 2
name = "{self.rack}"
extends = {json.dumps(self.extends)}
python_path = ["{Path(__file__).parents[3]}"]

[clock]
period_ms = 10.0
mode = "lockstep"

[adapter.lan]
slot = 2
rate_hz = {self.rate_hz}
listen = ["tcp/127.0.0.1:{port}"]
insecure = true
connect = {json.dumps(connect)}
peers = ["{peer}"]
{"".join(one.text(slot) for slot, one in enumerate(self.streams, 3))}"""


def real(file: str, name: str, folder: Path) -> RackConfig:
    """Return the config of a shipped rack under a name of its own, where `cell` stands in its
    name."""
    for path in (CONFIGS / "cell").glob("*.toml"):
        text = re.sub(r'"cell(?=["/-])', f'"{name}', path.read_text().replace('"../', '"'))
        (folder / path.name).write_text(text)
    return listening(folder / f"{file}.toml")


def listening(path: Path) -> RackConfig:
    """Return a config in lockstep, with a network of nobody but those that connect to it."""
    endpoint = f'listen=["tcp/127.0.0.1:{find_free_port()}"]'
    own = (endpoint, "insecure=true", "connect=[]", "launch=[]", "estop_from=[]")
    lan = (f"adapter.lan.{setting}" for setting in own)
    return load(path, ["clock.mode=lockstep", *lan])


def run(rack: RackConfig, senders: Sequence[Sender], folder: Path) -> Ended:
    """Run a rack with those that stand in for the others, until they have sent everything."""
    assert rack.adapter.lan is not None
    found = [rack]
    for k, sender in enumerate(senders):
        path = folder / f"sender-{k}.toml"
        path.write_text(sender.text(find_free_port(), rack.name, rack.adapter.lan.listen))
        found.append(load(path))
    seconds = max(sender.seconds for sender in senders) + 1.0
    return run_together(found, [seconds] * len(found))[0]


def check(found: Ended, counts: Mapping[str, int]) -> None:
    """All boards live, no stop is latched, and exactly what no type permits is refused, import by
    import."""
    assert not found.outcome.faults, found.texts
    assert not {event.kind for event in found.events} & {"died", "detection"}, found.texts
    imports = {port: found.last["lan.status"][f"import_{port}"] for port in counts}
    assert {port: int(entry["refused"]) for port, entry in imports.items()} == counts
    assert all(entry["taken"] > 0 for entry in imports.values())


def test_every_type_that_shipped_racks_import_is_tested() -> None:
    text = "\n".join(path.read_text() for path in CONFIGS.rglob("*.toml"))
    found = re.findall(r"\[adapter\.lan\.import\.[^]]*\][^[]*?\ntype = \"(.*)\"", text)
    # Extreme meetings: tests/levels/systems/trajectory/test_meeting.py.
    meeting = "rack.levels.systems.trajectory.meeting:Meeting"
    assert set(found) == {ORDER, REPORT, BODIES, meeting} | BROWN


def orders_and_bodies(
    name: str, orders: Sequence[tuple[int, Case]], bodies: Sequence[tuple[int, Case]]
) -> list[Sender]:
    """Return the racks that stand in for those from which the PUMA imports."""
    plain = [(1, next(cases(CellOrder, {})))], [(1, next(cases(SharedBodies, {})))]
    return [
        Sender(name, [Stream("task.order_puma", ORDER, 10, orders or plain[0])]),
        Sender(f"{name}-k1607", [Stream("servo.shared", BODIES, 50, bodies or plain[1])]),
    ]


@pytest.mark.parametrize("action", ACTIONS)
def test_no_extreme_of_an_order_ends_a_board_of_an_arm(
    action: Mapping[str, Any], rack_name: str, tmp_path: Path
) -> None:
    orders = []
    for case in cases(CellOrder, {"id": 1, "program": 7, "what": OrderVerb.ASK, **action}):
        is_of_action = case[0].split()[0] in action
        if is_of_action or action is POSE:
            orders.append((PLANNED if is_of_action and case[2] else 1, case))
    senders = orders_and_bodies(rack_name, orders, ())
    found = run(real("puma", rack_name, tmp_path), senders, tmp_path)
    check(found, {"orders": senders[0].streams[0].refused, "shared": 0})


def test_no_extreme_of_a_shared_body_ends_a_board_of_an_arm(rack_name: str, tmp_path: Path) -> None:
    body = {
        "name": b"part",
        "claim": 3,
        "owner": b"other",
        "position": (0.6, 0.1, 0.475),
        "quaternion": (1, 0, 0, 0),
    }
    found = cases(SharedBodies, {"rack": b"other", "bodies": body})
    first = ("plain", "bodies.position", "bodies.quaternion")
    # At 0 the part is in the pedestal, an unintended contact. Last: greater claims, after which
    # this one is not heard.
    tried = sorted(
        (one for one in found if one[0] != "bodies.position = 0.0"),
        key=lambda one: one[0].split()[0] not in first,
    )
    senders = orders_and_bodies(rack_name, (), [(5, one) for one in tried])
    ended = run(real("puma", rack_name, tmp_path), senders, tmp_path)
    check(ended, {"orders": 0, "shared": senders[1].streams[0].refused})


def test_no_extreme_of_a_report_ends_a_coordinator(rack_name: str, tmp_path: Path) -> None:
    cell = real("cell", rack_name, tmp_path)
    checksum = CellProgram.model_validate(resolve(cell).config.task).checksum
    answer = {"program": checksum, "echo": 1000}
    rows = [
        *cases(CellReport, answer),
        *cases(CellReport, {**answer, "response": Response.DOING, "moves": 2}),
    ]
    # Last: a refusal that is permitted ends the program.
    refusal = {**answer, "response": Response.REFUSED, "error": Error.NO_PATH, "reason": b"no"}
    rows += sorted(cases(CellReport, refusal), key=lambda case: case[0] != "error = 65535")
    senders = [
        Sender(f"{rack_name}-{arm}", [Stream("task.report", REPORT, 10, [(2, c) for c in rows])])
        for arm in ("puma", "k1607")
    ]
    found = run(cell, senders, tmp_path)
    refused = senders[0].streams[0].refused
    check(found, {"puma": refused, "k1607": refused})


def rows_of(kind: str, bases: Iterable[Mapping[str, Any]], sizes: Mapping[str, int]) -> list[Case]:
    """Return the cases of a type, each with the next base, and with the plain one of that after
    it."""
    given = iter(bases)
    found = []
    for number, _ in enumerate(cases(message_class(kind), next(given), sizes)):
        found.append(list(cases(message_class(kind), next(given), sizes))[number])
        found.append(next(cases(message_class(kind), next(given), sizes)))
    return found


def brown(
    file: str, other: str, rack_name: str, folder: Path, bases: Bases
) -> tuple[Ended, Mapping[str, int]]:
    """Run a rack of brown with one that stands in for the other and sends what that one does;
    return how it ended, and how many messages it had to refuse, by port."""
    configs(rack_name, folder)
    rack = listening(folder / f"{file}.toml")
    assert rack.adapter.lan is not None
    sizes = compute_cell_sizes(rack)
    streams = {
        port: Stream(
            entry.mailbox,
            entry.type,
            round(entry.rate_hz),
            [(1, case) for case in rows_of(entry.type, bases(entry.mailbox, rack), sizes)],
        )
        for port, entry in rack.adapter.lan.imports.items()
    }
    sender = Sender(other, list(streams.values()), ["robots/puma560.toml"], 100.0)
    found = run(rack, [sender], folder)
    return found, {port: stream.refused for port, stream in streams.items()}


def asked_of_servo(mailbox: str, rack: RackConfig) -> Iterator[Mapping[str, Any]]:
    """Yield what the general machine sends in each of its cycles."""
    cell = build_rack_cell(rack)
    still = Dynamics(cell).terms(cell.home, np.zeros(len(cell.home)))
    for cycle in count(1):
        yield {
            "trajectory.command": {
                "id": cycle,
                # In its ticks of 5 ms: due two of its cycles later.
                "due": 4 * (cycle + 2),
                "position": cell.home,
                "inertia": still.inertia.diagonal(),
                "load": still.bias,
            },
            "modifications.command": {"id": cycle, "wanted": WRONG_NAMES},
            "planning.status": {"state": State.EXECUTING},
        }[mailbox]


def test_no_extreme_of_the_general_machine_ends_a_board_of_the_servo_rack(
    rack_name: str, tmp_path: Path
) -> None:
    found, refused = brown("servo", rack_name, rack_name, tmp_path, asked_of_servo)
    check(found, refused)
    last = found.last
    answers = [last[f"{board}.modified"]["reason"] for board in ("shoulder", "elbow", "wrist")]
    assert answers == [
        "no modification 'none'; permitted: pd, notch",
        "no modification ''; permitted: pd",
        "no modification 'notch'; permitted: deadzone",
    ]
    # The plain one was due when the run began.
    assert last["supervisor.status"]["reason"].startswith("rejected: a reference due in -")
    home = build_rack_cell(load("brown")).home
    assert last["arm.status"]["position"] == pytest.approx(home, abs=1e-3)


def told_by_servo(mailbox: str, rack: RackConfig) -> Iterator[Mapping[str, Any]]:
    """Yield what the servo rack sends in each of its cycles."""
    cell = build_rack_cell(rack)
    for cycle in count(1):
        yield {
            "supervisor.status": {
                "driven": 1,
                "holding": 1,
                "position": cell.home,
                "target": cell.home,
            },
            "world.model": {"revision": 1, "quaternion": (1, 0, 0, 0), "sensed": 20 * cycle},
        }.get(mailbox, {})


def test_no_extreme_of_the_servo_rack_ends_a_board_of_the_general_machine(
    rack_name: str, tmp_path: Path
) -> None:
    found, refused = brown("brown", f"{rack_name}-servo", rack_name, tmp_path, told_by_servo)
    check(found, refused)
    assert found.last["planning.status"]["error"] == 0, "no motion was planned from an extreme"
