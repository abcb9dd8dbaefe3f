"""The page of all keys says what the models of a config permit."""

from __future__ import annotations

from tests import reference


def test_the_page_of_all_keys_is_up_to_date() -> None:
    assert reference.PAGE.read_text() == reference.page(), "make reference writes it anew"
