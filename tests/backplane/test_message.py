"""Message types and messages: sizes, fields, text."""

from __future__ import annotations

import numpy as np
import pytest

from rack.backplane.errors import MailboxError
from rack.backplane.message import (
    REASON_BYTES,
    Field,
    Message,
    MessageType,
    State,
    command,
    field,
    fill_counts,
    status,
    text_of,
)


class Pose(Message, version=1):
    """Pose."""

    position: np.ndarray = field(unit="m", doc="", shape=3)
    valid: int = field("u1", unit="1", doc="")


class Track(Message, version=2):
    """Track."""

    count: int = field("u2", unit="1", doc="poses")
    poses: np.ndarray = field(Pose, doc="way", shape="poses")
    angle: np.ndarray = field(unit="rad", doc="joints", shape=("joints", 2))
    word: str = field("S4", doc="")


SIZES = {"poses": 5, "joints": 6}


@pytest.fixture
def track() -> Message:
    return Track.zeros(SIZES)


def test_symbolic_sizes_are_filled_in() -> None:
    dtype = Track.message_type.dtype(SIZES)
    assert dtype["angle"].shape == (6, 2)
    assert dtype["poses"].shape == (5,)
    assert dtype["poses"].base["position"].shape == (3,)
    assert dtype.fields is not None
    assert all(offset % field.alignment == 0 for field, offset in dtype.fields.values())


def test_an_unknown_size_is_refused_with_the_known_ones() -> None:
    with pytest.raises(
        MailboxError, match=r"'track' field 'poses': size 'poses' is unknown; known sizes: joints"
    ):
        Track.message_type.dtype({"joints": 6})


@pytest.mark.parametrize("wrong", [["raw"], ["copy_from"], ["_hidden"], ["x", "x"]])
def test_a_field_that_no_message_could_show_is_refused(wrong: list[str]) -> None:
    with pytest.raises(MailboxError, match=f"message 'bad': field '{wrong[-1]}'"):
        MessageType("bad", 1, tuple(Field(name, "f8", "1", "") for name in wrong))


def test_a_misspelt_field_is_refused_in_writing_and_in_reading(track: Message) -> None:
    with pytest.raises(AttributeError, match="cuont"):
        track.cuont = 3
    with pytest.raises(AttributeError, match="no field 'cuont'; fields: count, poses, angle, word"):
        _ = track.cuont


def test_scalars_read_as_plain_numbers_that_fit_their_fields(track: Message) -> None:
    track.count = 7
    assert type(track.count) is int
    assert track.count == 7
    with pytest.raises(OverflowError):
        track.count = 70_000


def test_arrays_are_views_of_the_bytes(track: Message) -> None:
    angle = track.angle
    track.angle = np.arange(12.0).reshape(6, 2)
    angle[0, 1] = -1.0
    assert track.record["angle"][0].tolist() == [0.0, -1.0]
    assert (
        track.raw[Track.message_type.dtype(SIZES).fields["angle"][1] :][8:16].cast("d")[0] == -1.0
    )


def test_a_group_is_filled_field_by_field(track: Message) -> None:
    track.poses["position"][2] = (1, 2, 3)
    track.poses[2]["valid"] = 1
    assert track.record["poses"]["position"][2].tolist() == [1.0, 2.0, 3.0]
    assert track.record["poses"]["valid"].tolist() == [0, 0, 1, 0, 0]


def test_text_reads_as_text_cut_to_its_field(track: Message) -> None:
    track.word = "gripper"
    assert track.word == "grip"
    track.word = "né"
    assert track.word == "n?"
    # Nothing of the longer text stays.
    assert bytes(track.raw).count(b"ip") == 0


def test_text_reads_with_escapes_in_place_of_control_characters(track: Message) -> None:
    for content, shown in ((b"\x1b[2J", r"\x1b[2J"), (b"a\n\x7f", r"a\n\x7f"), (b"a\\b", r"a\b")):
        track.word = content
        assert track.word == text_of(content) == shown
        # As often as it is passed on.
        assert text_of(shown.encode()) == shown
    assert text_of(b"\xe9t") == "\N{REPLACEMENT CHARACTER}t"


def test_clear_and_copy_take_every_byte(track: Message) -> None:
    track.count, track.word = 3, "abc"
    track.angle[:] = 2.5
    other = Track.zeros(SIZES)
    other.copy_from(track)
    assert bytes(other.raw) == bytes(track.raw)
    track.clear()
    assert bytes(track.raw) == bytes(len(track.raw))


def test_commands_begin_with_their_serial_and_statuses_with_the_answer() -> None:
    move = command("move", 1, Field("goal", "f8", "rad", ""))
    moving = status("moving", 1, Field("at", "f8", "rad", ""))
    assert [f.name for f in move.fields] == ["id", "goal"]
    assert [f.name for f in moving.fields] == ["echo", "state", "error", "reason", "at"]
    answer = Message(moving.dtype({}))
    answer.state, answer.reason = State.ERROR, "x" * 500
    assert State(answer.state) is State.ERROR
    assert len(answer.reason) == REASON_BYTES


def test_counts_stay_at_the_greatest_number_of_their_fields() -> None:
    fields = (
        Field("few", "u2", "1", ""),
        Field("many", "u4", "1", ""),
        Field("tick", "i8", "tick", ""),
    )
    message = Message(MessageType("counts", 1, (*fields, Field("age_s", "f8", "s", ""))).dtype({}))
    fill_counts(message.record, (1 << 70, 1 << 32, 1 << 63, 1e30))
    assert message.record.tolist() == ((1 << 16) - 1, (1 << 32) - 1, (1 << 63) - 1, 1e30)
    fill_counts(message.record, (7, 8, -1, -1.0))
    assert message.record.tolist() == (7, 8, -1, -1.0)
    fill_counts(message.record[["many"]], (1 << 32,))
    assert (message.few, message.many) == (7, (1 << 32) - 1)
