"""A TCP relay that delays all bytes, in place of a network that is slow.

Not every kernel can delay packets (`netem`). What one connection delivers stays in order.

Usage: `python -m tests.slow_link LISTEN_PORT TARGET_PORT DELAY_MS`.
"""

from __future__ import annotations

import asyncio
import sys
from asyncio import StreamReader, StreamWriter
from contextlib import suppress

HOST = "127.0.0.1"
ANY = "0.0.0.0"
MOST_BYTES = 1 << 16


async def relay(reader: StreamReader, writer: StreamWriter, delay_s: float) -> None:
    """Pass on what arrives, each piece `delay_s` after its arrival, until either side ends."""
    loop = asyncio.get_running_loop()
    pieces = asyncio.Queue[tuple[float, bytes]]()

    async def receive() -> None:
        with suppress(OSError):
            while piece := await reader.read(MOST_BYTES):
                pieces.put_nowait((loop.time() + delay_s, piece))
        pieces.put_nowait((loop.time(), b""))

    receiving = asyncio.create_task(receive())
    with suppress(OSError):
        while True:
            due_s, piece = await pieces.get()
            if not piece:
                break
            await asyncio.sleep(due_s - loop.time())
            writer.write(piece)
            await writer.drain()
    receiving.cancel()
    writer.close()


async def serve(listen_port: int, target_port: int, delay_s: float) -> None:
    """Relay every connection to `listen_port` to `target_port`."""

    async def connect(reader: StreamReader, writer: StreamWriter) -> None:
        try:
            there, back = await asyncio.open_connection(HOST, target_port)
        except OSError:
            # The other end is not there yet: whoever connects tries again.
            writer.close()
            return
        await asyncio.gather(relay(reader, back, delay_s), relay(there, writer, delay_s))

    server = await asyncio.start_server(connect, ANY, listen_port)
    await server.serve_forever()


if __name__ == "__main__":
    asyncio.run(serve(int(sys.argv[1]), int(sys.argv[2]), float(sys.argv[3]) * 1e-3))
