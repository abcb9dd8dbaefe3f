"""Frames between a force and motion server and its client, on a TCP connection.

A frame is a head (`HEAD`) and a content. The server begins with HELLO. Afterwards it sends STATUS,
and the client sends REQUEST. In lockstep the client sends WAIT when it has nothing more to do, and
the rack's time stands still until then. Either side ends the conversation with END. Messages are
sent as their bytes, so a client needs the same version of the project.
"""

from __future__ import annotations

import select
import socket
from collections.abc import Sequence
from contextlib import suppress
from enum import IntEnum
from struct import Struct
from typing import NamedTuple

from rack.levels.errors import LevelError

HEAD = Struct("<4sBI")
"""Head of a frame: `MAGIC`, kind, and length of the content in bytes."""
MAGIC = b"RFM1"
MAX_CONTENT_BYTES = 1 << 20
TICK_AND_TIME = Struct("<qd")
"""Beginning of a STATUS: tick, and simulated time in s. The status follows, if there is one yet."""
TIMEOUT = Struct("<d")
"""Content of WAIT: longest simulated time to wait, in s."""


class FrameKind(IntEnum):
    """Kinds of frames."""

    HELLO = 1  # JSON: what the client must know of the rack
    STATUS = 2  # `TICK_AND_TIME`, and the newest `ServerStatus`
    REQUEST = 3  # a `ServerRequest`
    WAIT = 4  # `TIMEOUT`; answered with STATUS
    END = 5  # text: why the side has failed; empty if all is well


class NetworkFrame(NamedTuple):
    """A received frame."""

    kind: FrameKind
    content: bytes


class FrameError(LevelError):
    """The other end does not send valid frames."""


class Connection:
    """One end of a TCP connection, without waiting.

    Args:
        connected: The connected socket.

    Attributes:
        socket: The socket, for `select`.
        peer: Address of the other end, as text.
    """

    def __init__(self, connected: socket.socket) -> None:
        self.socket = connected
        host, port = connected.getpeername()[:2]
        self.peer = f"{host}:{port}"
        connected.setblocking(False)
        connected.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._received = bytearray()
        self._unsent = bytearray()

    def receive(self) -> bool:
        """Receive bytes that have arrived. Return False if the other end has closed."""
        try:
            data = self.socket.recv(MAX_CONTENT_BYTES)
        except BlockingIOError:
            return True
        except OSError:
            return False
        self._received += data
        return bool(data)

    def take_frame(self) -> NetworkFrame | None:
        """Return the oldest frame that was received as a whole.

        Raises:
            FrameError: The bytes are not a frame.
        """
        if len(self._received) < HEAD.size:
            return None
        magic, kind, length = HEAD.unpack_from(self._received)
        if magic != MAGIC or kind not in set(FrameKind) or length > MAX_CONTENT_BYTES:
            raise FrameError(f"{bytes(self._received[: HEAD.size])!r} does not begin a frame")
        end = HEAD.size + length
        if len(self._received) < end:
            return None
        content = bytes(self._received[HEAD.size : end])
        del self._received[:end]
        return NetworkFrame(FrameKind(kind), content)

    def send(self, kind: FrameKind, content: bytes = b"") -> None:
        """Send a frame, and keep what the network does not take yet for `flush`."""
        self._unsent += HEAD.pack(MAGIC, kind, len(content)) + content
        self.flush()

    def flush(self) -> bool:
        """Send what is unsent. Return True if nothing is left. Errors show when receiving."""
        with suppress(OSError):
            del self._unsent[: self.socket.send(self._unsent) if self._unsent else 0]
        return not self._unsent

    def close(self, timeout_s: float = 0.0) -> None:
        """Close the connection, after at most `timeout_s` for what is unsent."""
        with suppress(OSError):
            self.socket.settimeout(timeout_s)
            self.socket.sendall(self._unsent)
        self.socket.close()


def await_sockets(
    sockets: Sequence[socket.socket], timeout_s: float | None, unsent: Sequence[socket.socket] = ()
) -> list[socket.socket]:
    """Wait until a socket can be read, or until one of `unsent` can be written.

    Args:
        sockets: Sockets to read.
        timeout_s: Longest wait in s. None to wait for ever.
        unsent: Those among `sockets` with data that is not sent yet.

    Returns:
        The sockets that can be read.
    """
    # Unlike `select.select`, a poll has no limit for the numbers of descriptors.
    poll = select.poll()
    for one in sockets:
        poll.register(one, select.POLLIN | (select.POLLOUT if one in unsent else 0))
    events = dict(poll.poll(None if timeout_s is None else 1e3 * timeout_s))
    return [one for one in sockets if events.get(one.fileno(), 0) & ~select.POLLOUT]
