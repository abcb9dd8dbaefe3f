"""The accesses that the code makes to a mailbox are those of the model, in its order: Python's as
they are recorded, and the machine code's as they stand in LLVM's instructions."""

from __future__ import annotations

import inspect
import re
import textwrap
from collections.abc import Callable, Iterator
from typing import Any

import pytest

from rack.backplane.mailbox.claim import MailboxClaim
from rack.backplane.mailbox.mailbox import Reader, Writer
from rack.backplane.mailbox.slots import SIGNED_FROM, Slots
from rack.backplane.segment import Segment
from rack.backplane.words import Box, Slot
from rack.boards.run import compiled_mailbox
from rack.levels import compiled as compilation
from rack.levels.compiled import compiled
from tests.backplane.bus import NAME, mailbox
from tests.backplane.conftest import MakeBus
from tests.backplane.mailbox.model import CLAIM, JUDGE, LOSE, PUBLISH, READ, TAKE_OVER

WORDS = {
    Box.HEAD: "head",
    Box.CLAIMANT: "claim",
    **dict.fromkeys(range(Box.BEGUN, Box.BEGUN + Box.EPOCHS), "begun"),
}


class Recorded:
    """The head of a mailbox, or a slot: notes the accesses to what `name_of` has a name for."""

    def __init__(
        self, memory: memoryview, name_of: Callable[[Any], str | None], accesses: list[str]
    ) -> None:
        self._memory, self._name_of, self._accesses = memory, name_of, accesses

    def __getitem__(self, at: Any) -> Any:
        self._note("load", at)
        return self._memory[at]

    def __setitem__(self, at: Any, value: Any) -> None:
        self._note("store", at)
        self._memory[at] = value

    def _note(self, what: str, at: Any) -> None:
        if name := self._name_of(at):
            self._accesses.append(f"{what} {name}")


def name_part(part: slice) -> str:
    """Return the name of a part of a slot."""
    names = {(None, SIGNED_FROM): "signature", (SIGNED_FROM, None): "message"}
    return names[part.start, part.stop]


class RecordedWords:
    """The words at the head of a slot: notes that it is emptied. Loads of single words decide
    nothing."""

    def __init__(self, words: memoryview, accesses: list[str]) -> None:
        self._words, self._accesses = words, accesses

    def __getitem__(self, at: int) -> int:
        return self._words[at]

    def __setitem__(self, at: int, value: int) -> None:
        assert (at, value) == (Slot.SERIAL, 0)
        self._accesses.append("clear slot")
        self._words[at] = value


@pytest.fixture
def accesses(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """All accesses to mailboxes that are opened from here on."""
    made: list[str] = []
    box_of, begin = Segment.get_box, Slots.__init__

    def opened(slots: Any, *arguments: Any) -> None:
        begin(slots, *arguments)
        slots.places = [Recorded(place, name_part, made) for place in slots.places]
        slots.heads = [RecordedWords(words, made) for words in slots.heads]

    monkeypatch.setattr(
        Segment, "get_box", lambda segment, name: Recorded(box_of(segment, name), WORDS.get, made)
    )
    monkeypatch.setattr(Slots, "__init__", opened)
    monkeypatch.setattr(Slots, "fence", staticmethod(lambda: made.append("fence")))
    return made


def of_python(segment: Segment, accesses: list[str]) -> dict[str, tuple[str, ...]]:
    """Return the accesses of the Python classes, by the model's name for what they do."""

    def made(action: Callable[[], object], without: str = "") -> tuple[str, ...]:
        accesses.clear()
        action()
        return tuple(access for access in accesses if access != without)

    writer = Writer(segment, NAME)
    reader = Reader(segment, NAME)
    # The writer looks whether another process has published; it publishes all the same.
    found = {
        "publish": made(lambda: writer.write(0), "load head"),
        "first read": made(lambda: reader.read(1)),
    }
    writer.write(1)
    found |= {
        "read": made(lambda: reader.read(2)),
        "judge": made(lambda: reader.slots.is_intact(2)),
        "lose": made(writer.lose_message),
    }
    # A writer that dies before it publishes what it has filled.
    writer.slots.serial += 1
    filled = writer.slots.heads[writer.slots.serial & writer.slots.mask]._words
    filled[Slot.SERIAL] = 4
    writer.close()
    # It continues after the newest message and the newest epoch.
    loads = ("load head", "load claim")
    claim = made(lambda: Writer(segment, NAME).close())
    found["claim"] = tuple(access for access in claim if access not in loads)
    filled[Slot.SERIAL] = 4
    standby = Writer(segment, NAME, is_held=True)
    taken = made(standby.take_over)
    # What it loads before the first store, the claim and the bounds decide nothing in the model.
    later = taken[taken.index("store begun") :]
    found["take over"] = tuple(one for one in later if one not in ("load claim", "load begun"))
    return found


EXPECTED = {
    "publish": PUBLISH,
    "lose": LOSE,
    "first read": READ,
    "read": READ,
    "judge": JUDGE,
    "claim": CLAIM,
    "take over": TAKE_OVER,
}


def test_python_makes_the_accesses_of_the_model_in_its_order(
    make_bus: MakeBus, accesses: list[str]
) -> None:
    assert of_python(make_bus(mailbox(depth=4)), accesses) == EXPECTED


def changed(function: Any, before: str, after: str) -> Any:
    """Return a function with another text."""
    source = textwrap.dedent(inspect.getsource(function))
    assert before in source
    text = re.sub(r"^@.*\n", "", source.replace(before, after))
    found: dict[str, Any] = {}
    exec(text, dict(function.__globals__), found)
    return found[function.__name__]


FENCE = "self.fence()\n"
PUBLISHING = (Slots, "publish_message")
FILL = "self.places[at][SIGNED_FROM:]"
PYTHON_MUTANTS: dict[str, tuple[type, str, str, str]] = {
    "head before slot": (
        *PUBLISHING,
        f"{FENCE}    {FILL}",
        f"{FENCE}    box[0] = serial\n    {FILL}",
    ),
    "relaxed store of the head": (*PUBLISHING, f"{FENCE}    box[0] = serial", "box[0] = serial"),
    "no fence before a slot is filled": (*PUBLISHING, f"{FENCE}    {FILL}", FILL),
    "signature before message": (*PUBLISHING, "[SIGNED_FROM:]", "[:SIGNED_FROM]"),
    "relaxed load of the head": (Reader, "read", "slots.fence()\n", "pass\n"),
    "signature loaded after the message": (Slots, "load_slot", FENCE, "pass\n"),
    "relaxed load of the claim": (Slots, "load_slot", f"that.\n    {FENCE}", "that.\n"),
    "no fence before a copy is judged": (Slots, "is_intact", FENCE, "pass\n"),
    "slots of a dead writer left filled": (
        Slots,
        "clear_unpublished",
        "words[_SERIAL] = 0",
        "pass",
    ),
    "claim after publication": (
        MailboxClaim,
        "begin_epoch",
        "box[Box.CLAIMANT] = signature",
        "signature",
    ),
}
"""Mistakes in the code, as the model knows them: class, method, its text and another one."""


@pytest.mark.parametrize("mistake", PYTHON_MUTANTS)
def test_a_mutant_of_the_python_classes_changes_the_order(
    make_bus: MakeBus, accesses: list[str], monkeypatch: pytest.MonkeyPatch, mistake: str
) -> None:
    owner, method, before, after = PYTHON_MUTANTS[mistake]
    monkeypatch.setattr(owner, method, changed(getattr(owner, method), before, after))
    assert of_python(make_bus(mailbox(depth=4)), accesses) != EXPECTED


# Machine code

PATTERNS = (
    (r"^$", ("branch",)),
    (r"fence acq_rel", ("fence",)),
    (r"load atomic .* acquire", ("load head", "fence")),
    (r"store atomic .* release", ("fence", "store head")),
    (r"call .*@memcpy\(.* 16\)", ("copy signature",)),
    (r"call .*@memcpy", ("copy message",)),
    (r"@XXH3", ("check",)),
)
"""Instructions, and what they do by the model's names."""


def instructions(function: str) -> list[str]:
    """Return the accesses in the machine code of a function, in their order."""
    machine: Any = compiled_mailbox.access_ports.load_machine_code()
    (text,) = machine.inspect_llvm().values()
    name = rf"compiled_mailbox\d+{function}B\w*"
    body = re.search(rf"^define linkonce_odr [^\n]*{name}\(.*?^}}", text, re.MULTILINE | re.DOTALL)
    assert body
    found: list[str] = []
    for line in body[0].splitlines():
        for pattern, accesses in PATTERNS:
            if re.search(pattern, line):
                found += accesses
                break
    return found


def of_machine_code() -> dict[str, tuple[str, ...]]:
    """Return the accesses of the machine code, by the model's name for what they do."""
    written = instructions("publish")
    written = [one for one in written[written.index("check") + 1 :] if one != "branch"]
    read = instructions("read_port")
    # Before the first branch it loads the head, then looks, message by message, which is visible.
    taken = instructions("take")
    read = read[: read.index("branch")] + taken[: taken.index("check")]
    return {
        "publish": tuple(one.replace("copy", "store") for one in written),
        "read": tuple(one.replace("copy", "load") for one in read if one != "branch"),
    }


@pytest.fixture
def compile_all(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[], None]]:
    """Compile all functions of mailboxes, without the cache: what comes from there has no text."""
    monkeypatch.setattr(compilation._CodeCache, "load_overload", lambda *_: None)
    monkeypatch.setattr(compilation._CodeCache, "save_overload", lambda *_: None)
    functions = [one for one in vars(compiled_mailbox).values() if isinstance(one, compiled)]
    before = [one._machine for one in functions]

    def load() -> None:
        for function in vars(compiled_mailbox).values():
            if isinstance(function, compiled):
                function._machine = None
        compiled_mailbox.access_ports.preload()

    yield load
    for function, machine in zip(functions, before, strict=True):
        function._machine = machine


# The claim is a plain load after the check. test_compiled_mailbox.py shows that it counts.
MACHINE_CODE = {"publish": PUBLISH, "read": READ[:-1]}


@pytest.mark.thorough
def test_machine_code_makes_the_accesses_of_the_model_in_its_order(
    compile_all: Callable[[], None],
) -> None:
    compile_all()
    assert of_machine_code() == MACHINE_CODE


COMPILED_FENCE = "    fence()\n"
COMPILED_FILL = "    copy(slot + SIGNED"
MACHINE_MUTANTS: dict[str, tuple[str, str, str]] = {
    "head before slot": (
        "publish",
        f"{COMPILED_FENCE}{COMPILED_FILL}",
        f"{COMPILED_FENCE}    store_release(port.head, before + 1)\n{COMPILED_FILL}",
    ),
    "relaxed store of the head": (
        "publish",
        "store_release(port.head, before + 1)",
        "copy(port.head, port.record, 8)",
    ),
    "no fence before a slot is filled": (
        "publish",
        f"{COMPILED_FENCE}{COMPILED_FILL}",
        COMPILED_FILL,
    ),
    "signature before message": ("publish", "    fence()\n    copy(slot, ", "    copy(slot, "),
    "relaxed load of the head": ("read_port", "load(port.head)", "slot_at(port.head).stamp"),
    "signature loaded after the message": (
        "take",
        "    fence()\n    copy(port.record",
        "    copy(port.record",
    ),
    "relaxed load of the claim": ("take", "    fence()\n    received", "    received"),
}
"""Mistakes in the compiled functions: function, its text and another one."""


@pytest.mark.thorough
@pytest.mark.parametrize("mistake", MACHINE_MUTANTS)
def test_a_mutant_of_the_compiled_code_changes_the_order(
    compile_all: Callable[[], None], monkeypatch: pytest.MonkeyPatch, mistake: str
) -> None:
    name, before, after = MACHINE_MUTANTS[mistake]
    function = changed(getattr(compiled_mailbox, name)._function, before, after)
    monkeypatch.setattr(compiled_mailbox, name, compiled(function))
    compile_all()
    assert of_machine_code() != MACHINE_CODE
