"""A bus or UART with its nodes: node id assignment, start, stop."""
