"""The line between the Rack and its crate: length-prefixed pickles on a pair of connected sockets.

Both ends are this program's own processes, started by one another; nothing else can reach the sockets.
"""

from __future__ import annotations

import pickle
import socket
import struct
from typing import Any

_LENGTH = struct.Struct("<Q")


class Channel:
    """One end of the line."""

    def __init__(self, end: socket.socket) -> None:
        self.socket = end

    def fileno(self) -> int:
        """Return the descriptor, for poll."""
        return self.socket.fileno()

    def send(self, message: Any) -> None:
        """Send one object. Raises `OSError` when the other end is gone."""
        data = pickle.dumps(message)
        self.socket.sendall(_LENGTH.pack(len(data)) + data)

    def receive(self) -> Any:
        """Return the next object; None when the other end is gone."""
        head = self._exactly(_LENGTH.size)
        body = self._exactly(_LENGTH.unpack(head)[0]) if head else None
        return pickle.loads(body) if body else None

    def _exactly(self, count: int) -> bytes | None:
        data = bytearray()
        while len(data) < count:
            try:
                part = self.socket.recv(count - len(data))
            except ConnectionResetError:
                return None
            if not part:
                return None
            data += part
        return bytes(data)
