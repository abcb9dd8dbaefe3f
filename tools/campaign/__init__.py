"""`rack campaign`: faults of all kinds at random, and what came of each."""
