"""Tests the export to rosbag2: independent readers get the values of the recording, bit for bit."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import Reader

from rack.backplane.layout import FieldSpec
from rack.backplane.mailbox.history import build_row_dtype
from rack.boards.config import load, resolve_layout
from rack.levels.robot.engine import view_state
from rack.tools.ecosystem.ros_messages import RosEncoder
from rack.tools.ecosystem.rosbag2 import MailboxEncoder, export_bag
from rack.tools.recording.recording import Recording

SECOND_NS = 10**9
Messages = dict[str, list[tuple[int, Any]]]
"""Messages of each topic, with their times in ns."""


@pytest.fixture(scope="module")
def bag(nasrem: Recording) -> Path:
    path = nasrem.folder / "bag"
    shown: list[float] = []
    assert export_bag(nasrem, path, shown.append) > 0
    assert shown == sorted(shown)
    return path


@pytest.fixture(scope="module")
def messages(bag: Path) -> Messages:
    """Messages of the bag, as `mcap-ros2-support` decodes them by the definitions in the file."""
    found: Messages = {}
    with (bag / "bag.mcap").open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        for _, channel, message, decoded in reader.iter_decoded_messages():
            found.setdefault(channel.topic, []).append((message.log_time, decoded))
    return found


def read_stamp(stamp: Any) -> int:
    return int(stamp.sec * SECOND_NS + stamp.nanosec)


@pytest.mark.slow
def test_joint_states_have_the_numbers_of_the_servo_status(
    nasrem: Recording, messages: Messages
) -> None:
    def read(*names: str) -> list[list[float]]:
        columns = [nasrem.read_signal("servo.status", name) for name in names]
        return np.column_stack(columns).tolist()  # type: ignore[no-any-return]

    states = [state for _, state in messages["/joint_states"]]
    assert {tuple(state.name) for state in states} == {
        ("j1", "j2", "j3", "j4", "j5", "j6", "finger_left")
    }
    assert [state.position for state in states] == read("position", "opening")
    assert [state.velocity for state in states] == read("velocity", "opening_velocity")
    assert [state.effort for state in states] == read("torque", "grip_force")
    ticks = nasrem.read_signal("servo.status", "tick")
    times = (ticks * nasrem.layout.clock_ns).tolist()
    assert [read_stamp(state.header.stamp) for state in states] == times
    assert [time for time, _ in messages["/joint_states"]] == times


@pytest.mark.slow
def test_every_message_of_every_mailbox_is_in_the_bag_bit_for_bit(
    nasrem: Recording, messages: Messages
) -> None:
    exported = {topic for topic in messages if topic.startswith("/mailbox/")}
    assert exported == {f"/mailbox/{name.replace('.', '/')}" for name in nasrem.mailboxes}
    for name in nasrem.mailboxes:
        rows = nasrem.read_rows(name)
        found = [message for _, message in messages[f"/mailbox/{name.replace('.', '/')}"]]
        for column in ("serial", "tick", "visible_at", "stamp_ns"):
            assert [getattr(m, f"message_{column}") for m in found] == rows[column].tolist()
        compare(nasrem.layout.find_mailbox(name).fields, found, rows["message"])


def compare(fields: tuple[FieldSpec, ...], found: list[Any], records: np.ndarray) -> None:
    """Compare the fields of decoded messages with those of the records they were made from."""
    for field in fields:
        values = [getattr(message, field.name) for message in found]
        column = records[field.name]
        flat = column.reshape(len(records), -1)
        if field.fields:
            parts = [part for value in values for part in (value if field.shape else [value])]
            compare(field.fields, parts, column.reshape(-1))
        elif column.dtype.kind == "S":
            assert values == [text.decode() for text in column.tolist()]
        else:
            made = np.array(values, column.dtype).reshape(flat.shape)
            assert made.tobytes() == np.ascontiguousarray(flat).tobytes(), field.name


@pytest.mark.slow
def test_poses_are_those_of_the_model_in_the_recorded_state(
    nasrem: Recording, messages: Messages
) -> None:
    import mujoco

    from rack.boards.config.cell import build_rack_cell

    cell = build_rack_cell(nasrem.rack_config)
    data = cell.build_start_data()
    states = nasrem.read_signal("servo.state", "state")
    ticks = nasrem.read_signal("servo.state", "tick").tolist()
    moments = messages["/tf"]
    assert np.diff([time for time, _ in moments]).max() == SECOND_NS // 50
    for time, message in moments[::40]:
        view_state(cell.model, data, states[ticks.index(time // nasrem.layout.clock_ns)])
        mujoco.mj_kinematics(cell.model, data)
        for transform in message.transforms:
            body = data.body(transform.child_frame_id)
            place, turn = transform.transform.translation, transform.transform.rotation
            assert transform.header.frame_id == "world"
            assert read_stamp(transform.header.stamp) == time
            assert [place.x, place.y, place.z] == body.xpos.tolist()
            assert [turn.w, turn.x, turn.y, turn.z] == body.xquat.tolist()
        assert len(message.transforms) == cell.model.nbody - 1


@pytest.mark.slow
def test_statuses_and_diagnostics_have_the_values_of_the_run(
    nasrem: Recording, messages: Messages
) -> None:
    rack = nasrem.layout.rack
    levels = {"servo", "primitive", "elemental_move", "task"}
    assert {topic for topic in messages if topic.startswith("/rack/")} == {
        f"/rack/{level}/status" for level in levels
    }
    ticks = nasrem.read_signal("servo.status", "tick").tolist()
    openings = nasrem.read_signal("servo.status", "opening")
    for time, status in messages["/rack/servo/status"][::20]:
        values = {pair.key: pair.value for pair in status.values}
        row = ticks.index(time // nasrem.layout.clock_ns)
        assert float(values["opening"]) == openings[row]
        assert (status.name, status.message) == (f"{rack}: servo", values["state"])
        assert (status.level, status.hardware_id) == (0, rack)
    counts: dict[str, int] = {}
    for _, array in messages["/diagnostics"]:
        for status in array.status:
            values = {pair.key: pair.value for pair in status.values}
            counts[status.name] = counts.get(status.name, 0) + int(values["cycles"])
    assert counts == {f"{rack}: {task}": len(rows) for task, rows in nasrem.cycles.items()}
    logged = [(entry.name, entry.msg) for _, entry in messages["/rosout"]]
    assert logged == [
        (event["board"] or rack, f"{event['kind']}: {event['text']}")
        for event in nasrem.events
        if event.get("tick", -1) >= 0
    ]


@pytest.mark.slow
def test_definitions_have_units_meanings_and_names_of_values(bag: Path) -> None:
    with (bag / "bag.mcap").open("rb") as file:
        reader = make_reader(file)
        assert reader.get_header().profile == "ros2"
        summary = reader.get_summary()
    assert summary is not None
    schemas = {schema.name: schema for schema in summary.schemas.values()}
    assert {schema.encoding for schema in schemas.values()} == {"ros2msg"}
    text = schemas["rack_msgs/msg/ServoStatus"].data.decode()
    assert "float64[] torque  # torque given to the arm in this cycle" in text
    assert "[N m]" in text
    assert "uint8 STATE_HOLDING=4\n" in text
    moves = schemas["rack_msgs/msg/TaskCommand"].data.decode()
    assert re.search(r"^rack_msgs/TaskCommandMoves\[\] moves", moves, re.MULTILINE)
    assert "MSG: rack_msgs/TaskCommandMoves\nuint32 id" in moves


@pytest.mark.slow
def test_the_folder_is_a_bag_for_rosbags(bag: Path, messages: Messages) -> None:
    with Reader(bag) as reader:
        counts = {connection.topic: connection.msgcount for connection in reader.connections}
        assert reader.message_count == sum(counts.values())
        ends = reader.start_time, reader.end_time - 1
    assert counts == {topic: len(found) for topic, found in messages.items()}
    times = [time for found in messages.values() for time, _ in found]
    assert ends == (min(times), max(times))
    with AnyReader([bag]) as reader:
        chosen = [c for c in reader.connections if c.topic == "/mailbox/servo/status"]
        for (connection, _, raw), (_, other) in zip(
            reader.messages(chosen), messages["/mailbox/servo/status"], strict=True
        ):
            message: Any = reader.deserialize(raw, connection.msgtype)
            assert message.position.tolist() == other.position


def test_messages_of_one_name_may_have_different_fields(small: Path) -> None:
    config = load(small, [])
    layout = resolve_layout(config)
    mailboxes = MailboxEncoder(RosEncoder(layout, config))
    boxes = [layout.find_mailbox(f"{level}.status") for level in ("upper", "lower")]
    same = [replace(box, message="exchange", fields=box.fields[n:]) for n, box in enumerate(boxes)]
    for box in same:
        assert len([*mailboxes.encode(box, np.zeros(2, build_row_dtype(box)))]) == 2
    assert {*mailboxes.definitions} == {"rack_msgs/msg/UpperStatus", "rack_msgs/msg/LowerStatus"}


def test_mailboxes_whose_names_have_the_same_words_have_types_of_their_own(small: Path) -> None:
    config = load(small, [])
    layout = resolve_layout(config)
    mailboxes = MailboxEncoder(RosEncoder(layout, config))
    box = layout.find_mailbox("lower.status")
    found = {}
    for name, fields in (("a.b_c", box.fields), ("a_b.c", box.fields[1:]), ("aB.c", box.fields)):
        named = replace(box, name=name, fields=fields)
        (message,) = mailboxes.encode(named, np.zeros(1, build_row_dtype(named)))
        found[message.topic] = mailboxes.store.deserialize_cdr(
            message.data, message.topic.type_name
        )
    assert [topic.name for topic in found] == ["/mailbox/a/b_c", "/mailbox/a_b/c", "/mailbox/aB/c"]
    assert [topic.type_name for topic in found] == [
        "rack_msgs/msg/ABC",
        "rack_msgs/msg/ABCX",
        "rack_msgs/msg/AbC",
    ]
    first = box.fields[0].name
    assert [hasattr(message, first) for message in found.values()] == [True, False, True]
