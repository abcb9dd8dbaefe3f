"""Message types and messages: sizes, fields, text."""

from __future__ import annotations

from enum import IntEnum
from typing import Any

import numpy as np
import pytest

from rack.backplane.errors import MailboxError
from rack.backplane.message import (
    REASON_BYTES,
    AnyMessage,
    Command,
    Message,
    State,
    Status,
    decode_text,
    field,
    fill_counts,
    make_message,
)
from rack.backplane.message_type import Field, MessageType


class Pose(Message, version=1):
    position: np.ndarray = field(unit="m", doc="", shape=3)
    valid: int = field("u1", unit="1", doc="")


class Track(Message, version=2):
    count: int = field("u2", unit="1", doc="poses")
    poses: np.ndarray = field(Pose, doc="way", shape="poses")
    angle: np.ndarray = field(unit="rad", doc="joints", shape=("joints", 2))
    word: str = field("S4", doc="")


SIZES = {"poses": 5, "joints": 6}


@pytest.fixture
def track() -> Track:
    return Track.zeros(SIZES)


def test_symbolic_sizes_are_filled_in() -> None:
    dtype = Track.message_type.build_dtype(SIZES)
    assert dtype["angle"].shape == (6, 2)
    assert dtype["poses"].shape == (5,)
    assert dtype["poses"].base["position"].shape == (3,)
    assert dtype.fields is not None
    assert all(offset % field.alignment == 0 for field, offset in dtype.fields.values())


def test_an_unknown_size_is_refused_with_the_known_ones() -> None:
    with pytest.raises(
        MailboxError, match=r"'track' field 'poses': size 'poses' is unknown; known sizes: joints"
    ):
        Track.message_type.build_dtype({"joints": 6})


class Colour(IntEnum):
    """Names of numbers."""

    RED = 0
    BLUE = 2


@pytest.mark.parametrize(
    ("name", "hint", "declared", "why"),
    [
        ("raw", float, field(unit="1", doc=""), "must be annotated"),
        ("copy_from", float, field(unit="1", doc=""), "not named like an attribute"),
        ("_x", float, field(unit="1", doc=""), "without leading '_'"),
        ("x", None, field(unit="1", doc=""), "must be annotated"),
        ("x", float, field(doc=""), 'has no unit; the unit of a pure number is "1"'),
        ("x", float, field("i4", unit="1", doc=""), "numpy type 'i4' does not hold float"),
        ("x", float, field("f99", unit="1", doc=""), "data type 'f99' not understood"),
        ("x", int, field("u1", unit="1", doc="", default=256), "default 256 does not fit"),
        ("x", str, field("S2", doc="", default="abc"), "default 'abc' does not fit"),
        ("x", float, field(unit="1", doc="", shape=3), "does not suit float"),
        ("x", np.ndarray, field(unit="1", doc=""), "does not suit ndarray"),
    ],
)
def test_a_field_that_no_message_may_have_is_refused_with_class_and_field(
    name: str, hint: type | None, declared: Any, why: str
) -> None:
    body = {name: declared, "__annotations__": {} if hint is None else {name: hint}}
    with pytest.raises(MailboxError, match=f"^message class Bad: field '{name}': .*{why}"):
        type(Message)("Bad", (Message,), body, version=1)


def test_a_misspelt_field_is_refused_with_the_nearest_one(track: Track) -> None:
    with pytest.raises(AttributeError, match="'track' has no field 'cuont'; did you mean 'count'"):
        track.cuont = 3  # type: ignore[attr-defined]
    with pytest.raises(AttributeError, match="'track' has no field 'raw'; fields: count, poses"):
        track.raw = memoryview(b"")
    with pytest.raises(AttributeError, match="no field 'cuont'; did you mean 'count'"):
        _ = track.cuont  # type: ignore[attr-defined]
    with pytest.raises(AttributeError, match="no field 'xyz'; fields: count, poses, angle, word"):
        _ = track.xyz  # type: ignore[attr-defined]


def test_a_class_has_the_fields_of_its_bases_first_and_its_name_in_words() -> None:
    class Base(Command):
        first: int = field(unit="1", doc="")
        second: float = field(unit="1", doc="")

    class LongPath(Base, version=3):
        third: Colour = field("u2", doc="")
        first: int = field("i4", unit="1", doc="again, in its old place")

    made = LongPath.message_type
    assert (made.name, made.version) == ("long_path", 3)
    assert [(f.name, f.kind) for f in made.fields] == [
        ("id", "u4"),
        ("first", "i4"),
        ("second", "f8"),
        ("third", "u2"),
    ]


class Lamp(Message, version=1):
    on: bool = field(doc="")
    colour: Colour = field(doc="")


def test_flags_read_as_bools_and_numbers_as_enum_members_where_they_have_names() -> None:
    lamp = Lamp.zeros({})
    lamp.on, lamp.colour = True, Colour.BLUE
    assert (lamp.on, lamp.colour) == (True, Colour.BLUE)
    assert isinstance(lamp.colour, Colour)
    # A number without a name is a plain one.
    lamp.record["colour"] = 7
    assert type(lamp.colour) is int
    assert lamp.colour == 7
    lamp.colour = Colour.BLUE
    assert lamp.colour is Colour.BLUE


def test_scalars_read_as_plain_numbers_that_fit_their_fields(track: Track) -> None:
    track.count = 7
    assert type(track.count) is int
    assert track.count == 7
    with pytest.raises(OverflowError):
        track.count = 70_000


def test_arrays_are_views_of_the_bytes(track: Track) -> None:
    angle = track.angle
    track.angle = np.arange(12.0).reshape(6, 2)
    angle[0, 1] = -1.0
    assert track.record["angle"][0].tolist() == [0.0, -1.0]
    assert (
        track.raw[Track.message_type.build_dtype(SIZES).fields["angle"][1] :][8:16].cast("d")[0]
        == -1.0
    )


def test_a_group_is_filled_field_by_field(track: Track) -> None:
    track.poses["position"][2] = (1, 2, 3)
    track.poses[2]["valid"] = 1
    assert track.record["poses"]["position"][2].tolist() == [1.0, 2.0, 3.0]
    assert track.record["poses"]["valid"].tolist() == [0, 0, 1, 0, 0]


def test_text_reads_as_text_cut_to_its_field(track: Track) -> None:
    track.word = "gripper"
    assert track.word == "grip"
    track.word = "né"
    assert track.word == "n?"
    # Nothing of the longer text stays.
    assert bytes(track.raw).count(b"ip") == 0


def test_text_reads_with_escapes_in_place_of_control_characters(track: Track) -> None:
    for content, shown in ((b"\x1b[2J", r"\x1b[2J"), (b"a\n\x7f", r"a\n\x7f"), (b"a\\b", r"a\b")):
        track.word = content
        assert track.word == decode_text(content) == shown
        # As often as it is passed on.
        assert decode_text(shown.encode()) == shown
    assert decode_text(b"\xe9t") == "\N{REPLACEMENT CHARACTER}t"


def test_clear_and_copy_take_every_byte(track: Track) -> None:
    track.count, track.word = 3, "abc"
    track.angle[:] = 2.5
    other = Track.zeros(SIZES)
    other.copy_from(track)
    assert bytes(other.raw) == bytes(track.raw)
    track.clear()
    assert bytes(track.raw) == bytes(len(track.raw))


def test_commands_begin_with_their_serial_and_statuses_with_the_answer() -> None:
    move = make_message("move", Command, {"goal": field(unit="tick", doc="")})
    moving = make_message("moving", Status, {"at": field(unit="tick", doc="")})
    assert [f.name for f in move.message_type.fields] == ["id", "goal"]
    names = [f.name for f in moving.message_type.fields]
    assert names == ["echo", "state", "error", "reason", "at"]
    answer = moving.zeros({})
    answer.state, answer.reason = State.ERROR, "x" * 500
    assert answer.state is State.ERROR
    assert len(answer.reason) == REASON_BYTES


def test_counts_stay_at_the_greatest_number_of_their_fields() -> None:
    fields = (
        Field("few", "u2", "1", ""),
        Field("many", "u4", "1", ""),
        Field("tick", "i8", "tick", ""),
    )
    message = AnyMessage(
        MessageType("counts", 1, (*fields, Field("age_s", "f8", "s", ""))).build_dtype({})
    )
    fill_counts(message.record, (1 << 70, 1 << 32, 1 << 63, 1e30))
    assert message.record.tolist() == ((1 << 16) - 1, (1 << 32) - 1, (1 << 63) - 1, 1e30)
    fill_counts(message.record, (7, 8, -1, -1.0))
    assert message.record.tolist() == (7, 8, -1, -1.0)
    fill_counts(message.record[["many"]], (1 << 32,))
    assert (message.few, message.many) == (7, (1 << 32) - 1)
