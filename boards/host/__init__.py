"""Host boards: programs without real-time guarantees, connected through a bus adapter."""
