"""A hand of fingers driven by pairs of tendons: its plant, and its loops from tendon tension to grasp."""
