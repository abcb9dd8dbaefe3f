"""Print the tracking error of 6 s for each value of a key: python measure.py KEY VALUE..."""

import sys
from shutil import rmtree

import rack

key, *values = sys.argv[1:]
for value in values:
    out = f"run-{key}-{value}"
    rmtree(out, ignore_errors=True)
    with rack.Rack("late.toml", settings={key: int(value)}, out=out) as run:
        run.run(seconds=6)
    motion = rack.open_run(out).report["motion"]
    print(f"{key} = {value}: {motion['tracking_rms_mrad']:.3f} mrad RMS")
