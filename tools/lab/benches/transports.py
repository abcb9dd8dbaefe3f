"""Transports of messages between tasks, for comparison with the mailboxes of rack.

All are used from Python in their fastest form. The sender fills numpy views of a local message and
hands over its bytes, and every reader gets the bytes into its local message. Nothing listens on a
network. Names in shared memory and in the file system are removed as soon as both ends are open,
and nothing is left even if the process is killed.
"""

from __future__ import annotations

import ctypes
import multiprocessing
import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from shutil import rmtree
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np

from rack.backplane.message import AnyMessage
from rack.backplane.segment import SHM_FOLDER

SERVICE_NAME = "rack"


class Transport(NamedTuple):
    """An open transport with its sender and its readers.

    Fill `message`, call `send` with a tick, then call every reader with the same tick. Each returns
    the message that it received.

    Attributes:
        message: Local message of the sender.
        send: Sends the message.
        readers: One function per reader, which receives the message.
    """

    message: AnyMessage
    send: Callable[[int], object]
    readers: Sequence[Callable[[int], AnyMessage]]


class Peer(NamedTuple):
    """A transport that is compared with the mailboxes of rack.

    Attributes:
        name: Name in tables.
        module: Python module that it needs.
        open_transport: Opens it for a message type and a number of readers.
    """

    name: str
    module: str
    open_transport: Callable[[np.dtype, int], AbstractContextManager[Transport]]


@contextmanager
def open_iceoryx2_blackboard(dtype: np.dtype, readers: int) -> Iterator[Transport]:
    """Open a transport that updates an iceoryx2 blackboard entry, which every reader copies."""
    message = AnyMessage(dtype)
    with _open_iceoryx2_node() as (iceoryx2, node):
        payload = _build_structure(dtype)
        key = ctypes.c_uint64(0)
        creator = node.service_builder(iceoryx2.ServiceName.new(SERVICE_NAME)).blackboard_creator(
            ctypes.c_uint64
        )
        service = creator.add(key, payload()).max_readers(readers).create()
        writer = service.writer_builder().create()
        payload_bytes = payload.from_buffer(message.raw)
        entry = writer.entry(key, payload)
        entries = [service.reader_builder().create().entry(key, payload) for _ in range(readers)]

    def build_fetch(reader: Any) -> Callable[[memoryview], None]:
        """Build a function that copies a reader's newest value into a buffer."""
        get = reader.get

        def fetch(raw: memoryview) -> None:
            """Copy the newest value into `raw`."""
            raw[:] = get().data

        return fetch

    message_readers = [_build_reader(dtype, build_fetch(reader)) for reader in entries]
    yield Transport(message, lambda tick: entry.update_with_copy(payload_bytes), message_readers)


@contextmanager
def open_multiprocessing_pipe(dtype: np.dtype, readers: int) -> Iterator[Transport]:
    """Open a transport that sends the bytes through a pipe to each reader."""
    message = AnyMessage(dtype)
    pipes = [multiprocessing.Pipe(duplex=False) for _ in range(readers)]

    def send(tick: int) -> None:
        """Send the bytes of the message through every pipe."""
        for _, sender in pipes:
            sender.send_bytes(message.raw)

    try:
        yield Transport(
            message, send, [_build_reader(dtype, receiver.recv_bytes_into) for receiver, _ in pipes]
        )
    finally:
        for end in (end for pipe in pipes for end in pipe):
            end.close()


@contextmanager
def open_horus_image(dtype: np.dtype, readers: int) -> Iterator[Transport]:
    """Open a transport that sends the bytes as a grey one-row image through a HORUS topic.

    No other HORUS message carries an arbitrary number of bytes.
    """
    message = AnyMessage(dtype)
    namespace = f"rack_bench_{os.getpid()}"
    os.environ["HORUS_NAMESPACE"] = namespace
    import horus

    try:
        image = horus.Image(1, dtype.itemsize, "mono8")
        topic = horus.Topic(horus.Image)
        topics = [horus.Topic(horus.Image) for _ in range(readers)]
    finally:
        rmtree(SHM_FOLDER / f"horus_{namespace}", ignore_errors=True)

    def send(tick: int) -> None:
        """Send the bytes of the message as an image."""
        image.copy_from(bytes(message.raw))
        topic.send(image)

    def build_fetch(receive: Callable[[], Any]) -> Callable[[memoryview], None]:
        """Build a function that copies the next received image into a buffer."""

        def fetch(raw: memoryview) -> None:
            """Copy the next image into `raw`."""
            raw[:] = np.asarray(receive()).reshape(-1).data

        return fetch

    yield Transport(
        message, send, [_build_reader(dtype, build_fetch(reader.recv)) for reader in topics]
    )


PEERS = (
    Peer("iceoryx2 blackboard", "iceoryx2", open_iceoryx2_blackboard),
    Peer("HORUS image", "horus", open_horus_image),
    Peer("multiprocessing pipe", "multiprocessing", open_multiprocessing_pipe),
)


def _build_reader(
    dtype: np.dtype, fetch: Callable[[memoryview], object]
) -> Callable[[int], AnyMessage]:
    """Build a function that fills a local message with `fetch` and returns it."""
    message = AnyMessage(dtype)
    raw = message.raw

    def read_message(tick: int) -> AnyMessage:
        """Receive the bytes of a message into the local message, and return it."""
        fetch(raw)
        return message

    return read_message


@contextmanager
def _open_iceoryx2_node() -> Iterator[tuple[Any, Any]]:
    """Open an iceoryx2 node for services.

    The names of its files and shared memory are removed when the context ends.
    """
    import iceoryx2

    iceoryx2.set_log_level(iceoryx2.LogLevel.Fatal)
    prefix = f"rack_bench_{os.getpid()}_"
    with TemporaryDirectory(prefix=prefix) as folder:
        config = iceoryx2.config.default()
        config.global_cfg.root_path = iceoryx2.Path.new(folder)
        config.global_cfg.prefix = iceoryx2.FileName.new(prefix)
        builder = iceoryx2.NodeBuilder.new().config(config)
        # This process handles signals itself.
        builder = builder.signal_handling_mode(iceoryx2.SignalHandlingMode.Disabled)
        try:
            yield iceoryx2, builder.create(iceoryx2.ServiceType.Ipc)
        finally:
            for leftover in SHM_FOLDER.glob(f"{prefix}*"):
                leftover.unlink(missing_ok=True)


def _build_structure(dtype: np.dtype) -> type[ctypes.Structure]:
    """Return a C structure of the size and alignment of a message."""
    words = ctypes.c_uint64 * (dtype.itemsize // 8)
    return type("Message", (ctypes.Structure,), {"_fields_": [("words", words)]})
