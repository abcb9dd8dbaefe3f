"""No number on which this room is built changes unseen."""

from __future__ import annotations

from tests.room_numbers import check_numbers


def test_no_number_changes_unseen() -> None:
    check_numbers(__file__)
