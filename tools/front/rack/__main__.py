"""The command line as `python -m rack`."""

from __future__ import annotations

from rack.tools.cli import main

if __name__ == "__main__":
    main()
