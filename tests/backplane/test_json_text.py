"""JSON that every program reads."""

from __future__ import annotations

import json
from math import inf, nan

import pytest

from rack.backplane.json_text import encode_json


@pytest.mark.parametrize("number", [nan, inf, -inf])
def test_a_number_that_is_not_finite_is_null_at_any_depth(number: float) -> None:
    text = encode_json({"a": number, "b": [1, (number, {"c": number})], "d": 0.5}, indent=2)
    found = json.loads(text, parse_constant=pytest.fail)
    assert found == {"a": None, "b": [1, [None, {"c": None}]], "d": 0.5}


def test_other_data_are_encoded_as_by_the_standard_library() -> None:
    document = {"a": [1, 2.5, None, True, "ü"], "b": {"c": ()}}
    assert encode_json(document, indent=2) == json.dumps(document, indent=2)
