"""Ways to bring a message from one task to others: what `rack bench mailbox` compares our mailboxes
with.

All are used as their users use them from Python, in their fastest form: a local message with numpy
views of its fields is filled, its bytes are handed over, and every reader gets them into a local
message of its own. Nothing listens on a network. Names in shared memory and in the file system are
removed as soon as both ends are open, so that nothing is left even if the process is killed.
"""

from __future__ import annotations

import ctypes
import mmap
import multiprocessing
import os
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager
from functools import partial
from multiprocessing.queues import Queue
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np

from rack.backplane.json_text import encode_json
from rack.backplane.message import Message
from rack.backplane.segment import SHM_FOLDER
from rack.tools.console.answer import Failure

KEY = "rack"
SETTLE_S = 10.0
"""Longest wait until sessions have found each other."""


class Transport(NamedTuple):
    """Fill `message`, call `send` with a tick, then every reader with the same tick: each returns
    what it received."""

    message: Message
    send: Callable[[int], object]
    readers: Sequence[Callable[[int], Message]]


class Peer(NamedTuple):
    """A contestant: `opened` gives it for a message type and so many readers; `module` must be
    installed for it."""

    name: str
    module: str
    opened: Callable[[np.dtype, int], AbstractContextManager[Transport]]


@contextmanager
def raw_copy(dtype: np.dtype, readers: int) -> Iterator[Transport]:
    """Copy bytes into shared memory and out again: no serial, no check, no readers in step with the
    writer."""
    shared = mmap.mmap(-1, dtype.itemsize)
    message = Message(dtype)
    with memoryview(shared) as view:

        def send(tick: int) -> None:
            view[:] = message.raw

        def fetch(raw: memoryview) -> None:
            raw[:] = view

        yield Transport(message, send, [_into(dtype, fetch) for _ in range(readers)])


@contextmanager
def iceoryx2_publish_subscribe(dtype: np.dtype, readers: int) -> Iterator[Transport]:
    """Publish a copy on an iceoryx2 service; every subscriber takes it from shared memory."""
    message = Message(dtype)
    with _iceoryx2_names() as (iceoryx2, node):
        payload = _structure(dtype)
        name = iceoryx2.ServiceName.new(KEY)
        service = (
            node.service_builder(name).publish_subscribe(payload).max_subscribers(readers).create()
        )
        publisher = service.publisher_builder().create()
        own = payload.from_buffer(message.raw)
        subscribers = [service.subscriber_builder().create() for _ in range(readers)]
        # The first message connects them, by name.
        publisher.send_copy(own)
        for subscriber in subscribers:
            subscriber.receive()

    def taker(subscriber: Any) -> Callable[[int], Message]:
        received = Message(dtype)
        place = ctypes.addressof(ctypes.c_char.from_buffer(received.raw))
        size = dtype.itemsize
        receive = subscriber.receive

        def take(tick: int) -> Message:
            ctypes.memmove(place, receive().payload_ptr, size)
            return received

        return take

    yield Transport(
        message, lambda tick: publisher.send_copy(own), [taker(one) for one in subscribers]
    )


@contextmanager
def iceoryx2_blackboard(dtype: np.dtype, readers: int) -> Iterator[Transport]:
    """Update an entry of an iceoryx2 blackboard; every reader copies its newest value."""
    message = Message(dtype)
    with _iceoryx2_names() as (iceoryx2, node):
        payload = _structure(dtype)
        key = ctypes.c_uint64(0)
        creator = node.service_builder(iceoryx2.ServiceName.new(KEY)).blackboard_creator(
            ctypes.c_uint64
        )
        service = creator.add(key, payload()).max_readers(readers).create()
        writer = service.writer_builder().create()
        own = payload.from_buffer(message.raw)
        entry = writer.entry(key, payload)
        entries = [service.reader_builder().create().entry(key, payload) for _ in range(readers)]

    def fetcher(one: Any) -> Callable[[memoryview], None]:
        get = one.get

        def fetch(raw: memoryview) -> None:
            raw[:] = get().data

        return fetch

    takers = [_into(dtype, fetcher(one)) for one in entries]
    yield Transport(message, lambda tick: entry.update_with_copy(own), takers)


@contextmanager
def multiprocessing_pipe(dtype: np.dtype, readers: int) -> Iterator[Transport]:
    """Send bytes through a pipe to every reader."""
    message = Message(dtype)
    pipes = [multiprocessing.Pipe(duplex=False) for _ in range(readers)]

    def send(tick: int) -> None:
        for _, entrance in pipes:
            entrance.send_bytes(message.raw)

    try:
        yield Transport(
            message, send, [_into(dtype, way_out.recv_bytes_into) for way_out, _ in pipes]
        )
    finally:
        for end in (end for pipe in pipes for end in pipe):
            end.close()


@contextmanager
def multiprocessing_queue(dtype: np.dtype, readers: int) -> Iterator[Transport]:
    """Put bytes into a queue for every reader; a thread of the writer pickles and sends them."""
    message = Message(dtype)
    queues: list[Queue[bytes]] = [multiprocessing.Queue() for _ in range(readers)]

    def send(tick: int) -> None:
        for queue in queues:
            queue.put(bytes(message.raw))

    try:
        yield Transport(message, send, [_into(dtype, _copied(queue.get)) for queue in queues])
    finally:
        for queue in queues:
            queue.close()
            queue.join_thread()


@contextmanager
def zenoh_sessions(dtype: np.dtype, readers: int) -> Iterator[Transport]:
    """Put bytes on a key of a zenoh session; every subscriber has a session of its own, as in
    processes of their own.

    They are connected through a socket in the file system: nothing listens on a network.
    """
    import zenoh

    message = Message(dtype)
    with ExitStack() as stack:
        with TemporaryDirectory(prefix="rack-bench-") as folder:
            place = f"unixsock-stream/{folder}/zenoh"
            session = stack.enter_context(_zenoh(listen=place, connect=""))
            others = [stack.enter_context(_zenoh(listen="", connect=place)) for _ in range(readers)]
        # Full buffers delay a message; they do not drop it.
        blocks = zenoh.CongestionControl.BLOCK
        publisher = session.declare_publisher(KEY, congestion_control=blocks)
        subscribers = [other.declare_subscriber(KEY) for other in others]
        _await(session, others)
        takers = [_into(dtype, _copied(partial(_received, one))) for one in subscribers]
        yield Transport(message, lambda tick: publisher.put(bytes(message.raw)), takers)


def _zenoh(listen: str, connect: str) -> Any:
    """Return an open zenoh session that looks for no others."""
    import zenoh

    config = zenoh.Config()
    config.insert_json5("mode", '"peer"')
    # What it keeps in shared memory it leaves there.
    for key in ("scouting/multicast", "scouting/gossip", "transport/shared_memory"):
        config.insert_json5(f"{key}/enabled", "false")
    for key, place in (("listen", listen), ("connect", connect)):
        places = [place] if place else []
        config.insert_json5(f"{key}/endpoints", encode_json(places))
    try:
        return zenoh.open(config)
    except zenoh.ZError as error:
        raise Failure(f"zenoh: {' '.join(str(error).split())}") from None


def _await(session: Any, others: Sequence[Any]) -> None:
    """Wait until `session` knows what the others have subscribed to so far. Raises `Failure`."""
    deadline = time.monotonic() + SETTLE_S
    for number, other in enumerate(others):
        # Declarations of a session arrive in order: this one after all before it.
        mark = other.declare_subscriber(f"{KEY}/{number}")
        probe = session.declare_publisher(f"{KEY}/{number}")
        while not probe.matching_status.matching:
            if time.monotonic() > deadline:
                raise Failure(f"zenoh: sessions have not found each other within {SETTLE_S:g} s")
        mark.undeclare()


def _received(subscriber: Any) -> bytes:
    # Not `recv`: no signal interrupts that.
    while (sample := subscriber.try_recv()) is None:
        continue
    return bytes(sample.payload.to_bytes())


REFERENCES = (Peer("raw copy", "mmap", raw_copy),)
"""No peer: the least that can be done."""
PEERS = (
    Peer("iceoryx2 blackboard", "iceoryx2", iceoryx2_blackboard),
    Peer("iceoryx2 publish-subscribe", "iceoryx2", iceoryx2_publish_subscribe),
    Peer("multiprocessing pipe", "multiprocessing", multiprocessing_pipe),
    Peer("multiprocessing queue", "multiprocessing", multiprocessing_queue),
    Peer("zenoh", "zenoh", zenoh_sessions),
)


def _into(dtype: np.dtype, fetch: Callable[[memoryview], object]) -> Callable[[int], Message]:
    """Return a reader that lets `fetch` fill the bytes of a message of its own."""
    message = Message(dtype)
    raw = message.raw

    def take(tick: int) -> Message:
        fetch(raw)
        return message

    return take


def _copied(get: Callable[[], bytes]) -> Callable[[memoryview], None]:
    """Return a function that copies what `get` returns into the bytes of a message."""

    def fetch(raw: memoryview) -> None:
        raw[:] = get()

    return fetch


@contextmanager
def _iceoryx2_names() -> Iterator[tuple[Any, Any]]:
    """Give iceoryx2 and a node to open services with: files and shared memory have names while the
    context lasts."""
    import iceoryx2

    iceoryx2.set_log_level(iceoryx2.LogLevel.Fatal)
    prefix = f"rack_bench_{os.getpid()}_"
    with TemporaryDirectory(prefix=prefix) as folder:
        config = iceoryx2.config.default()
        config.global_cfg.root_path = iceoryx2.Path.new(folder)
        config.global_cfg.prefix = iceoryx2.FileName.new(prefix)
        builder = iceoryx2.NodeBuilder.new().config(config)
        # Signals are ours.
        builder = builder.signal_handling_mode(iceoryx2.SignalHandlingMode.Disabled)
        try:
            yield iceoryx2, builder.create(iceoryx2.ServiceType.Ipc)
        finally:
            for left in SHM_FOLDER.glob(f"{prefix}*"):
                left.unlink(missing_ok=True)


def _structure(dtype: np.dtype) -> type[ctypes.Structure]:
    """Return a C structure of the size and alignment of a message."""
    words = ctypes.c_uint64 * (dtype.itemsize // 8)
    return type("Message", (ctypes.Structure,), {"_fields_": [("words", words)]})
