"""Which nodes are on a bus, found by asking or by listening."""
