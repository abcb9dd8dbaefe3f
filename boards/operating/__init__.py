"""Commands of an operator: as a table, as a message, and given by the clock's board."""
