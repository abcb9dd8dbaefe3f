"""Print the peak of the first 10 s, with all levels in one process: python measure.py RATE_HZ..."""

import sys

from rack.boards import OneProcess

for rate_hz in sys.argv[1:]:
    with OneProcess.from_file("peak.toml", [f"board.peak.rate_hz={rate_hz}"]) as rack:
        rack.run(10.0)
        print(f"{rate_hz} Hz: peak {rack.newest('peak.status').speed:.4f} rad/s")
