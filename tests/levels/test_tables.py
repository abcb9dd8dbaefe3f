"""Tables of a config: the descriptions of their keys."""

from __future__ import annotations

from pydantic import Field

from rack.levels.tables import Table, describe_keys


class Base(Table):
    count: int = 1
    """counts of a cycle,
    at most"""
    step: int = Field(2, alias="by", ge=1)
    """what each of them adds"""
    start: int = Field(0, description="where counting begins")
    """no description: it has one"""
    bare: int = 3

    def doubled(self) -> int:
        bare: int = 2 * self.bare
        """Local: no key of the table."""
        return bare


class Own(Base):
    bare: int = 4
    """not bare any more"""


def test_the_text_below_a_field_is_its_description_unless_it_has_one() -> None:
    described = {key: field.description for key, field in describe_keys(Own).items()}
    assert described == {
        "count": "counts of a cycle, at most",
        "by": "what each of them adds",
        "start": "where counting begins",
        "bare": "not bare any more",
    }
    assert describe_keys(Base)["bare"].description is None
