"""Control of contact forces: the wrist sensor's wrench, hybrid motion/force control, and a server of both."""
