"""What runs on a board: its cycle, its task, its clock."""
