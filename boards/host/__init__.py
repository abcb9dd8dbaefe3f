"""Host boards: programs that take part through a bus adapter, without real time."""
