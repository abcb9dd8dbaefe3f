"""A user's program that runs a rack, and prints once it is launched.

python -m tests.boards.launcher CONFIG [--fork] [KEY=VALUE]...
"""

from __future__ import annotations

import os
import sys
import time

from rack.boards import Rack


def main(config: str, *settings: str) -> None:
    """Launch the rack, report it, and run it to its end."""
    with Rack.from_file(config, [s for s in settings if s != "--fork"]) as rack:
        if "--fork" in settings and os.fork() == 0:
            # A child that inherits every descriptor of the launcher and outlives it.
            time.sleep(60)
            os._exit(0)
        rack.start()
        sys.stdout.write("launched\n")
        sys.stdout.flush()
        while rack.watch(0.5):
            pass


if __name__ == "__main__":
    main(*sys.argv[1:])
