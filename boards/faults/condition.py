"""Conditions on which a fault begins: a field of a mailbox has a value, as in "elemental_move.status.verb == grasp"."""

from __future__ import annotations

import re
from enum import IntEnum

import numpy as np

from rack.backplane.layout import FieldSpec, Layout, MailboxSpec
from rack.backplane.message import State
from rack.levels.messages import Error, SegmentKind, Verb
from rack.levels.operator import Answer, Operation

FORM = re.compile(r"\s*([a-z]\w*\.[a-z]\w*)\.([a-z]\w*)\s*==\s*([+-]?\w+)\s*")
ENUMS: dict[str, type[IntEnum]] = {kind.__name__: kind for kind in (State, Verb, SegmentKind, Error, Operation, Answer)}
"""What the unit of a field may name instead of a unit."""


def condition(text: str, layout: Layout) -> tuple[int, int, int]:
    """Return a condition as mailbox, field and value: two indices and a number. Raises `LookupError` with a reason."""
    found = FORM.fullmatch(text)
    if found is None:
        raise LookupError('must be mailbox.field == value, as in "elemental_move.status.verb == grasp"')
    mailboxes = {mailbox.name: at for at, mailbox in enumerate(layout.mailboxes)}
    if found[1] not in mailboxes:
        raise LookupError(f"no mailbox is called '{found[1]}'; mailboxes: {', '.join(mailboxes)}")
    mailbox = layout.mailboxes[mailboxes[found[1]]]
    return mailboxes[mailbox.name], _field(found[2], mailbox), _value(found[3], _fields(mailbox)[found[2]])


def condition_text(when: tuple[int, int, int], layout: Layout) -> str:
    """Return a condition as it is written: the inverse of `condition`."""
    mailbox = layout.mailboxes[when[0]]
    field = mailbox.fields[when[1]]
    names = {int(item): item.name.lower() for item in ENUMS.get(field.unit, ())}
    return f"{mailbox.name}.{field.name} == {names.get(when[2], when[2])}"


def _field(name: str, mailbox: MailboxSpec) -> int:
    fields = _fields(mailbox)
    if name not in fields:
        known = ", ".join(fields) or "none"
        raise LookupError(f"'{mailbox.name}' has no integer field '{name}'; integer fields: {known}")
    return mailbox.fields.index(fields[name])


def _fields(mailbox: MailboxSpec) -> dict[str, FieldSpec]:
    """Return the fields that a condition can be on: integers, one value each."""
    return {f.name: f for f in mailbox.fields if not f.fields and not f.shape and np.dtype(f.kind).kind in "iu"}


def _value(text: str, field: FieldSpec) -> int:
    names = {item.name.lower(): int(item) for item in ENUMS.get(field.unit, ())}
    if text.lower() in names:
        return names[text.lower()]
    permitted = np.iinfo(field.kind)
    try:
        value = int(text)
    except ValueError:
        value = None
    if value is None or not permitted.min <= value <= permitted.max:
        known = ", ".join(names) or f"a number from {permitted.min} to {permitted.max}"
        raise LookupError(f"'{text}' is no value of '{field.name}'; permitted: {known}")
    return value
