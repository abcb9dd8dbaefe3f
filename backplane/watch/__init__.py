"""Detection of message faults and lost writers by the tasks that read their mailboxes."""
