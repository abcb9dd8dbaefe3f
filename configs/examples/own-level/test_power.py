from rack.boards import OneProcess


def test_the_meter_counts_what_the_motion_takes():
    with OneProcess.from_file("metered.toml") as rack:
        rack.run(2.0)
        resting = rack.newest("power.status").energy
        rack.run(4.0)
        assert rack.newest("power.status").energy > resting + 1.0
