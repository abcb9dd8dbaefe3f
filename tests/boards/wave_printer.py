"""A module that prints while it is imported."""

print("first\nsecond")  # noqa: T201
