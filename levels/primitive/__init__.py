"""The primitive level: paths become jerk-limited joint set points at its cycle, in the background and ahead."""
