"""`rack mailbox`: show the mailboxes of a running rack, or the content of one."""

from __future__ import annotations

from contextlib import nullcontext

from rack.backplane.json_text import encode_json
from rack.backplane.mailbox.history import MailboxRing
from rack.backplane.segment import Segment
from rack.tools.console.answer import Failure, print_answer
from rack.tools.console.parameters import Json, RackName, argument, option
from rack.tools.console.tables import create_console, format_fitted_records
from rack.tools.monitor.message_text import DROPPED, MessageFormatter, list_mailboxes
from rack.tools.monitor.polling import poll_run
from rack.tools.recording.signal import find_mailbox

READ_INTERVAL_S = 0.1
PLAIN_INTERVAL_S = 1.0
"""Wall-clock time between two readings: for a terminal or JSON, and for plain text."""


def mailbox(
    rack: RackName,
    name: str | None = argument("NAME", "mailbox; default: all are listed", None),
    watch: bool = option("--watch", "show each message, until Ctrl-C or the end of the run", False),
    as_json: Json = False,
) -> None:
    """Show the newest message in a mailbox of a running rack, or list its mailboxes.

    The message is shown field by field with units. Reading does not delay the boards. With --watch
    and --json each message is one line.

    Exit status: 0 shown; 1 there is no such rack, or no message yet; 2 usage.

    \b
    Examples:
      rack mailbox nasrem
      rack mailbox nasrem servo.status
      rack mailbox nasrem primitive.command --watch
    """
    segment = Segment.attach(rack)
    if name is None:
        if watch:
            raise Failure("--watch needs the NAME of a mailbox", 2)
        rows = list_mailboxes(segment)
        print_answer(rows, format_fitted_records(rows, DROPPED), as_json)
        return
    box = find_mailbox(name, segment.layout.mailboxes)
    ring = MailboxRing(segment, box.name)
    formatter = MessageFormatter(box, segment.layout.clock_ns)
    if watch:
        _watch_mailbox(segment, ring, formatter, as_json)
        return
    messages = ring.read_new_rows().rows
    if not len(messages):
        raise Failure(f"mailbox '{name}' has no message yet")
    newest = formatter.to_document(messages[-1], segment.tick)
    print_answer(newest, formatter.format_lines(newest), as_json)


def _watch_mailbox(
    segment: Segment, ring: MailboxRing, formatter: MessageFormatter, as_json: bool
) -> None:
    """Show the newest message of a mailbox, then each new one until the run is over.

    JSON output contains every message. If several messages arrive between two readings, text output
    shows only the newest.
    """
    from rich.live import Live
    from rich.text import Text

    terminal = create_console()
    is_drawn = terminal.is_terminal and not as_json
    live = Live(console=terminal, auto_refresh=False) if is_drawn else None
    look_s = READ_INTERVAL_S if is_drawn or as_json else PLAIN_INTERVAL_S
    rows = ring.read_new_rows().rows[-1:]
    with live or nullcontext():
        for _ in poll_run(segment, look_s):
            tick = segment.tick
            documents = [
                formatter.to_document(row, tick) for row in (*rows, *ring.read_new_rows().rows)
            ]
            rows = rows[:0]
            if as_json:
                for document in documents:
                    print(encode_json(document), flush=True)
            elif live is not None and documents:
                live.update(Text("\n".join(formatter.format_lines(documents[-1]))), refresh=True)
            elif documents:
                print(*formatter.format_lines(documents[-1]), "", sep="\n", flush=True)
