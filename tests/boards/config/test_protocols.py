"""The keys of `[protocol]`, with their ranges and defaults, are those that users read."""

from __future__ import annotations

from tests import reference


def test_the_page_of_all_keys_has_those_of_the_protocols() -> None:
    assert reference.is_on_page("protocol")
