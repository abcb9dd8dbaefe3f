"""Print the tracking error of 6 s at each servo rate: python measure.py BANDWIDTH RATE_HZ..."""

import sys
from shutil import rmtree

import rack

bandwidth, *rates_hz = map(int, sys.argv[1:])
for rate_hz in rates_hz:
    settings = {
        "board.servo.params.bandwidth": bandwidth,
        "board.servo.rate_hz": rate_hz,
        "board.servo.within_cycles": rate_hz // 50,  # its planner keeps 20 ms
        "robot.substeps": 2000 // rate_hz,  # the simulated arm keeps its steps of 0.5 ms
    }
    out = f"run-{bandwidth}-{rate_hz}"
    rmtree(out, ignore_errors=True)
    with rack.Rack("rate.toml", settings=settings, out=out) as run:
        run.run(seconds=6)
    motion = rack.open_run(out).report["motion"]
    print(
        f"{rate_hz} Hz: {motion['tracking_rms_mrad']:.4f} mrad RMS,"
        f" {motion['tracking_peak_mrad']:.2f} peak"
    )
